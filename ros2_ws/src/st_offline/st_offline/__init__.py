"""Offline processing: checks, evaluation, identification, discovery, bands, reports."""
