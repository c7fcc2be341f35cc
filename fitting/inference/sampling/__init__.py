"""The posterior by ensemble sampling."""
