"""Rays: the Fermat system, the search for its roots, their derivatives."""
