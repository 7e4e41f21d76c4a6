"""At the desk: checks, evaluation, identification, discovery, bands, reports."""
