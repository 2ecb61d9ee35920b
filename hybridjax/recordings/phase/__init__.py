"""Where in its cycle a recorded system is: from an angle, crossings, or events."""
