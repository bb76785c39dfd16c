"""Configuration and the folder of a run."""
