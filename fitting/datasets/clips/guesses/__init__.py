"""What a motion file may leave open: its unit, and balls of feet that end at the ankle."""
