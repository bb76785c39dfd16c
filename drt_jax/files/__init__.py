"""Read lenses from files and write them to files."""
