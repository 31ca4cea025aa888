import numpy as np

from vcl_companion.vision.information import covariance_of


def test_units_do_not_decide_whether_something_is_fixed() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 6, 6))
    information = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(6)
    units = np.diag([1e-6, 1e6, 1.0, 1e3, 1e-3, 1.0])
    found = covariance_of(units @ information @ units, 1e-9)
    assert found is not None
    back = units @ found @ units
    np.testing.assert_allclose(back @ information, np.tile(np.eye(6), (5, 1, 1)), atol=1e-9)


def test_what_is_not_fixed_has_no_covariance() -> None:
    flat = np.diag([1.0, 1.0, 0.0])
    tied = np.array([[1.0, 1.0], [1.0, 1.0]])
    for information in (flat, tied, -np.eye(3), np.full((2, 2), np.nan)):
        assert covariance_of(information, 1e-9) is None
    assert covariance_of(np.stack([np.eye(2), tied]), 1e-9) is None
