from .coincidence import coincidences as coincidences
