def from_fmu(): pass
