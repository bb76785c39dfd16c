"""The lens: surfaces, glasses, the pytree, Gaussian optics."""
