"""Analyses of traced rays: moments, wavefront, PSF kernels, MTF, the sensor and its picture."""
