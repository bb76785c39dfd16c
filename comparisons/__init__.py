"""Other programs on our problems: `python -m comparisons.design`. Not a part of the package."""
