"""Systems of the literature, one a file: source, published numbers, and `problem(**parameters) -> Problem`."""
