"""Where rays cross the stop: quadrature rules."""
