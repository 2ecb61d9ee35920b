"""What limit cycles and branches of them are made of."""
