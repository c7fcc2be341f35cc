"""Pictures: each function draws one matplotlib figure. `style` has what they share."""
