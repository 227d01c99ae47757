"""The response of a gait comes back from its file as it was, and what cannot be read is one line."""

import json

import pytest

from omniperception.sim.response import FILE, AxisResponse, ConditionResponse, Cycle, GaitResponse, NoResponse

AXIS = AxisResponse([0.9, 0.05], [0.1, 0.01], [0.02, 0.0], 6.0, [0.03, 0.01], 0.1, 0.3)
KNOWN = GaitResponse(
    2.5,
    {"x": [-1.0, 2.0], "y": [-1.5, 1.5], "yaw": [-1.5, 1.5]},
    0.25,
    0.15,
    {"ideal": ConditionResponse(1, {"x": AXIS, "y": AXIS, "yaw": AXIS}, 0.01, [0.02, 0.03], [[0.0, 0.5, 9, 1]])},
    (Cycle([1.0, 0.0, 0.0], [0.3, 0.31], [0.0, 0.1], [0.0, -0.1], [[0.1, 0.8], [0.2, 0.7]]),),
)


def test_it_comes_back_as_it_was(tmp_path):
    assert KNOWN.save(tmp_path) == tmp_path / FILE
    assert GaitResponse.load(tmp_path) == KNOWN


def test_numbers_are_saved_with_four_digits(tmp_path):
    GaitResponse(1 / 3, {}, 0.123456, 1234567.0, {}, ()).save(tmp_path)
    found = GaitResponse.load(tmp_path)
    assert (found.frequency, found.radius, found.half_length) == (0.3333, 0.1235, 1235000.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (None, "has no measured response of its gait .*; measure it: "),
        (lambda given: given | {"version": 0}, "is of another version of this program; measure it again: "),
        (lambda given: {k: v for k, v in given.items() if k != "version"}, "is of another version"),
        (lambda given: given | {"cycles": [{"height": 1}]}, "is damaged; measure it again: "),
        (lambda given: [given], "is damaged"),
    ],
)
def test_what_cannot_be_followed_is_one_line_with_the_command_that_mends_it(tmp_path, change, said):
    path = KNOWN.save(tmp_path)
    path.write_text(json.dumps(change(json.loads(path.read_text())))) if change else path.unlink()
    with pytest.raises(NoResponse, match=said) as error:
        GaitResponse.load(tmp_path)
    assert "\n" not in str(error.value) and str(error.value).endswith(f"gait run={tmp_path} what=response")


def test_a_file_that_is_cut_off_is_damaged(tmp_path):
    path = KNOWN.save(tmp_path)
    path.write_text(path.read_text()[:-9])
    with pytest.raises(NoResponse, match="is damaged"):
        GaitResponse.load(tmp_path)
