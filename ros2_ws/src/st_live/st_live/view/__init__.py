"""The live view in the browser: what it draws, how it is laid out, and the processes that serve it."""
