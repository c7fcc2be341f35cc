"""What an experiment file asks for."""
