"""What the rays make of a point: moments, wavefront, kernels, the sensor."""
