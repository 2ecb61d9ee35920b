from .points import Points as Points, sobol_points as sobol_points
