"""What is left out, counted in processes of runs; and claims that see what should not be there."""

from __future__ import annotations

import pytest

from neurosim_core.bench import leave_out


@pytest.fixture(scope="module")
def rows():
    cases = leave_out.cases(True)
    runs = ("IMU only", "events only")
    return [{"run": name, **leave_out.run_case(cases[name], seconds=0.1)} for name in runs]


def test_an_imu_alone_needs_no_pictures_and_no_libraries_for_scenes(rows):
    least, most = rows
    assert least["modules of kernels"] < most["modules of kernels"]
    assert least["their size [MiB]"] < 0.2 * most["their size [MiB]"]
    assert [claim.met for claim in leave_out._chapter(rows).claims] == [True, True]


def test_what_should_not_be_there_is_seen(rows):
    least = {**rows[0], "pictures": 1, "libraries": "scipy, trimesh"}
    assert [claim.met for claim in leave_out._chapter([least, rows[1]]).claims] == [False, False]


def test_a_run_that_fails_says_why():
    with pytest.raises(ValueError, match="cuda:77"):
        leave_out.run_case({**leave_out.cases(True)["IMU only"], "device": "cuda:77"}, seconds=0.1)
