from .trajectory import Event as Event
