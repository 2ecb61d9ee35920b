from .lti import (
    HarmonicStateSpace as HarmonicStateSpace,
    to_control as to_control,
    to_harmonic_state_space as to_harmonic_state_space,
    to_lti as to_lti,
    to_scipy as to_scipy,
)
from .xarray_datasets import from_xarray as from_xarray, to_xarray as to_xarray
