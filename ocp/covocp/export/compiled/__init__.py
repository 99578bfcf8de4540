"""What compiles, loads and compares: the folder, the build, the library, the package."""
