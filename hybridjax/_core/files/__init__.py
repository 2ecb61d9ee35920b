"""Reading and writing files: nothing of a user is lost, and no file is believed."""
