"""What recorded pictures show: which way the car turned, and whether they show what it saw."""
