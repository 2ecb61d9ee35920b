from .family import Points as Points
