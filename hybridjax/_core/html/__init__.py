"""What results show of themselves in notebooks."""
