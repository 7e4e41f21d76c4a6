"""One file per verb of the st command. A verb imports its libraries when it runs, so that `st --help` is fast."""
