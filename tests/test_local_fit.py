"""Polynomials from a CRS to the local frame against PROJ itself."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.local_fit import LARGEST_ERROR_M, LocalFit
from pipeline.geodesy.transform import to_enu


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-70.0, 70.0),
    st.floats(-179.0, 179.0),
    st.floats(-50.0, 3000.0),
    st.floats(50.0, 3000.0),
    st.sampled_from(["utm", "feet", "geographic"]),
    st.integers(0, 2**32 - 1),
)
def test_any_place_as_proj_has_it(
    latitude: float, longitude: float, height: float, size_m: float, kind: str, seed: int
) -> None:
    frame = LocalFrame(latitude, longitude, height)
    zone = int((longitude + 180.0) // 6.0) + 1
    utm = pyproj.CRS(f"EPSG:{(32600 if latitude >= 0.0 else 32700) + zone}").to_3d()
    crs = {
        "utm": utm,
        "feet": pyproj.CRS(f"+proj=tmerc +lat_0={latitude} +lon_0={longitude} +datum=WGS84 +units=us-ft").to_3d(),
        "geographic": pyproj.CRS("EPSG:4979"),
    }[kind]
    transform = to_enu(crs, frame, None, "ellipsoidal")
    corners = transform.from_enu(np.array([[-size_m, -size_m, -100.0], [size_m, size_m, 200.0]]))
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    fit = LocalFit.of(transform, lower, upper)
    points = np.random.default_rng(seed).uniform(lower, upper, (400, 3))
    found = fit.enu_from(points.T, transform).T
    assert found == pytest.approx(transform.enu_from(points), abs=2.0 * LARGEST_ERROR_M)


def test_outside_its_box_it_asks_proj() -> None:
    frame = LocalFrame(37.5, -78.3, 120.0)
    transform = to_enu(pyproj.CRS("EPSG:32617").to_3d(), frame, None, "ellipsoidal")
    lower, upper = transform.from_enu(np.array([[-100.0, -100.0, -50.0], [100.0, 100.0, 50.0]]))
    fit = LocalFit.of(transform, lower, upper)
    assert fit.everywhere
    far = upper + np.array([[20_000.0, 5_000.0, 3_000.0]])
    found = fit.enu_from(far.T, transform).T
    assert found == pytest.approx(transform.enu_from(far), abs=1e-6)
