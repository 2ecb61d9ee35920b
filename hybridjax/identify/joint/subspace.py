def subspace_model(series, dims, innovations):
    raise NotImplementedError
