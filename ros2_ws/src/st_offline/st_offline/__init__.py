"""The st command: demo, live, logs, benchmarks."""
