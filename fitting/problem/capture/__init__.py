"""What is not known of a capture, fitted beside a system. Start with `parameters.Capture`."""
