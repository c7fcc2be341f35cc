"""What a motion file may leave open, guessed: the balls of feet that end at the ankle."""
