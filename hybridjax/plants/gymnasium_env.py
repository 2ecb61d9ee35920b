def from_gymnasium(): pass
