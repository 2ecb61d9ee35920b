"""The made-up periodic system, against numbers that three other computations agree on: the periodic
state, the impulse response, and the DFT of a simulated cosine, all in 34 digits with mpmath."""

import numpy as np
import pytest

import hybridjax as hj


# H_m at f, entries [11, 12, 21, 22].
TRUTH = {
    (0.375, -1): [0.0870168190513334 - 0.104740591601557j, 0.136930404243867 - 0.00849364383439899j,
                  0.177542319766032 + 0.140249777743610j, 0.134084302352115 - 0.796760585940421j],
    (0.375, 0): [-0.0155718849200377 - 0.464519781537683j, 0.484791750769152 - 0.709348830936539j,
                 0.235944251031154 - 0.0967340260593198j, 0.0585691535423064 - 0.530709131326115j],
    (0.375, 1): [-0.197463738897656 - 0.135644964777583j, 0.0618068237928809 + 0.0962861563864056j,
                 -0.0812503237919122 - 0.0468651742365950j,
                 -0.0201885781660477 - 0.349237894484668j],
    (0.375, -3): [0.129440211654674 - 0.309710364604919j, 0.108293999329773 + 0.142151815209447j,
                  0.230149561273491 - 0.0164694307438428j,
                  0.00395711407298096 + 0.118194359053034j],
    (1.625, -2): [0.475877515178889 + 0.256577098584805j, -0.339553047966473 - 0.183100528413716j,
                  0.187680805609276 + 0.0872384969698475j,
                  -0.178822341466915 + 0.126416075679082j],
    (1.625, 0): [0.140386880184425 - 0.300228235870690j, 0.0150139226075515 - 0.476099969045470j,
                 -0.500707893221423 - 0.0742555981401889j,
                 -0.0857139174906250 - 0.217184053891879j],
    (1.625, 2): [-0.0494116126341986 + 0.329373837208814j,
                 -0.0776748978722265 + 0.261505315857721j,
                 0.111638050073311 - 0.180491401910538j, -0.154576116293404 + 0.0915279198993514j],
}  # fmt: skip


@pytest.fixture(scope="module")
def model():
    return hj.testing.synthetic_ldtp()


def test_multipliers(model):
    assert list(model.dims) == [3, 2, 3, 2, 3, 2]
    pair = 0.3270675 + 0.0596405918293070j
    np.testing.assert_allclose(model.multipliers, [pair, pair.conjugate()], rtol=1e-13)


@pytest.mark.parametrize("f, m", TRUTH)
def test_transfer_functions(model, f, m):
    H = model.htf([f], harmonics=(m,)).H[0, 0]
    np.testing.assert_allclose(np.ravel(H), TRUTH[f, m], rtol=0, atol=1e-13)


def test_experiments_find_its_transfer_functions(model):
    design = hj.multisine(n_sections=6, periods=16, band=(0, 2.0), inputs=2, amplitude=0.1)
    estimate = hj.estimate_htf(hj.experiments.simulate_experiments(model, design, start="periodic"))
    assert np.max(estimate.error(model.htf(estimate.f, estimate.harmonics))) < 1e-12
