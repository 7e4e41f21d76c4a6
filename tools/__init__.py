"""Developer tools, reached by ./st: tests, benchmarks and the generated pages of docs/. Not part of the product."""
