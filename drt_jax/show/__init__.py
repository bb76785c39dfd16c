"""Pictures; alone imports matplotlib."""
