"""What is written: C sources, headers, self-test and README as text."""
