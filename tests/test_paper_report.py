import numpy as np
from scipy.signal import find_peaks

from hybridjax.apps.paper_report import _peaks


def test_peaks_are_those_of_scipy():
    rng = np.random.default_rng(0)
    for values in (*rng.normal(size=(20, 50)), *np.cumsum(rng.normal(size=(20, 50)), axis=1)):
        assert _peaks(values, 0.7) == find_peaks(values, prominence=0.7)[0].tolist()
