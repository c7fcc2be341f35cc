"""What a fit minimises: free parameters, residuals, loss."""
