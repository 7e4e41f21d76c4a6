"""Developer tools, run with ./st: tests, benchmarks and the generated pages of docs/. Not part of the product."""
