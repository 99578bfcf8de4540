"""Solution methods, one a file, all with the same interface; no method knows another."""
