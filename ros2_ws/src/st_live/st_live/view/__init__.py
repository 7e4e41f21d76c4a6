"""Views of the suite: the passenger's page during a run, Rerun for recordings."""
