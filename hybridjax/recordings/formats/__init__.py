"""What files hold, format by format, as columns by name."""
