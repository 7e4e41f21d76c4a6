"""Manners shared by the nodes: parameters with unit and range, diagnostics, stamps, clean exit."""
