"""Goodness of fit: what the residuals say of the fit, and of the noise that was assumed."""
