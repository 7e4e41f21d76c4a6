"""Benchmarks, run with `./st bench NAME`; README.md lists them with the pages that quote their figures."""
