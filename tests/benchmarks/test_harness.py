"""The harness against closed forms and clocks that only work moves: timer, tables, fronts, references, meshes."""

import json
import math
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

from benchmarks.harness import timing
from benchmarks.harness.memory import buffer_bytes
from benchmarks.harness.meshes import tessellate, tessellate_to
from benchmarks.harness.pareto import Choice, Study
from benchmarks.harness.reference import compile_model, errors, mujoco_ranges, triangle_ranges
from benchmarks.harness.rotations import matrices, quat_about, quat_multiply
from benchmarks.harness.table import Table, about, write
from benchmarks.harness.timing import Timing, paired_ratio, paired_timings
from omnilidar.kernels.slots import Slots

# ---- timer -----------------------------------------------------------------------------------------------------------


def test_ratios_are_of_the_same_round(monkeypatch):
    now = 0.0

    def work(seconds):
        def call(number):
            nonlocal now
            now += seconds

        return call

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    monkeypatch.setattr(timing.time, "process_time", lambda: 2.0 * now)
    timings = paired_timings({"ours": work(0.01), "other": work(0.03)}, rounds=3)
    assert timings["ours"].wall_s == pytest.approx([0.01] * 3) and timings["ours"].median_cpu_s == pytest.approx(0.02)
    assert paired_ratio(timings["other"], timings["ours"]).median == pytest.approx(3.0)


def test_ratio_is_the_median_of_pairs_and_not_the_ratio_of_medians():
    ratio = paired_ratio(Timing([2.0, 9.0, 8.0], []), Timing([1.0, 1.0, 8.0], []))
    assert (ratio.median, ratio.smallest, ratio.largest) == (2.0, 1.0, 9.0)


# ---- tables ----------------------------------------------------------------------------------------------------------


def test_tables_are_written_with_their_provenance(tmp_path):
    table = Table.of("t", "how fast", [{"name": "ours", "ms": 1.5}, {"name": "none", "good": False}], ["a note"])
    write(table, about(2, seed=7), tmp_path)
    content = json.loads((tmp_path / "t.json").read_text())
    assert content["rows"][0] == {"name": "ours", "ms": 1.5, "good": None}
    found = content["provenance"]
    assert {"commit", "command", "date", "machine"} <= set(found) and (found["threads"], found["seed"]) == (2, 7)
    assert found["versions"]["warp-lang"]
    assert (tmp_path / "t.csv").read_text().startswith("name,ms,good,date,commit,cpu\nours,1.5,,20")
    text = (tmp_path / "t.md").read_text()
    assert "| ours | 1.5 | –    |" in text and "| none | –   | NO   |" in text and "a note" in text


# ---- fronts ----------------------------------------------------------------------------------------------------------


def study(*choices, floor=1e-6):
    return Study("name", "title", "cost (s)", "error (m)", choices, floor)


def choice(name, cost, error, default=False):
    return Choice(name, cost, {"error (m)": error}, default)


@pytest.mark.parametrize(
    ("choices", "front"),
    [
        ([("slow", 4.0, 0.1), ("fast", 1.0, 1.0), ("bad", 3.0, 2.0), ("mid", 2.0, 0.5)], ["fast", "mid", "slow"]),
        # a choice that failed, and costs that clocks cannot tell apart
        ([("exact", 1.02, 1e-3), ("near", 1.0, 0.5), ("lost", 0.1, math.inf)], ["exact"]),
        ([("cheap", 1.0, 1e-8), ("dear", 2.0, 1e-12)], ["cheap"]),  # errors below the floor are equal
    ],
)
def test_front_by_hand(choices, front):
    assert [c.name for c in study(*(choice(*c) for c in choices)).front] == front


def test_excess_is_the_cost_of_the_same_accuracy():
    a, b, c = choice("a", 1.0, 1.0), choice("b", 3.0, 0.99), choice("c", 4.0, 0.1)
    measured = study(a, b, c)
    assert measured.excess(a) == measured.excess(c) == 1.0 and measured.excess(b) == 3.0  # 0.99 is as good as 1


def test_words_say_what_the_default_trades():
    on = study(choice("a", 1.0, 1.0, default=True), choice("b", 2.0, 0.1)).words()
    assert "The default, a, is on it; b costs 2 times as much and errs 0.1 times as much." in on
    off = study(choice("a", 1.0, 1.0), choice("b", 2.0, 3.0, default=True)).words()
    assert "The default, b, is not on it: a costs 0.5 times as much and errs 0.33 times as much." in off
    assert "not among those measured" in study(choice("a", 1.0, 1.0)).words()


def test_a_study_is_a_table_with_marks():
    table = study(choice("a", 1.0, 1.0, default=True), choice("b", 2.0, 0.1)).table()
    assert [row[:3] for row in table.rows] == [["a", "default", "*"], ["b", "", "*"]]
    assert all(len(row) == len(table.columns) for row in table.rows)


# ---- references ------------------------------------------------------------------------------------------------------


@dataclass
class Ball:
    kinds = ("sphere",)
    sizes = np.array([[0.5, 0.0, 0.0]])
    plane: bool = False


def test_references_of_a_sphere_and_a_box_agree_with_closed_forms():
    origins = np.array([[-3.0, 0.0, 0.0]])
    directions = np.array([[1.0, 0.0, 0.0], [math.cos(0.1), math.sin(0.1), 0.0], [0.0, 1.0, 0.0]])
    slant = 3.0 * math.cos(0.1) - math.sqrt(0.25 - (3.0 * math.sin(0.1)) ** 2)
    by_hand = pytest.approx([2.5, slant, math.inf], abs=1e-12)
    model = compile_model(Ball())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for from_one in (origins[0], np.repeat(origins, 3, 0)):
        ranges, geoms = mujoco_ranges(model, data, from_one, directions)
        assert ranges == by_hand and geoms.tolist() == [0, 0, -1]
    vertices, faces = tessellate("box", (0.5, 0.5, 0.5))
    flat = pytest.approx([2.5, 2.5 / math.cos(0.1), math.inf])
    assert triangle_ranges(origins[0], directions, vertices[faces]) == flat


def test_triangles_let_nothing_through_their_edges_and_corners():
    x, y = np.meshgrid(np.linspace(-2.0, 2.0, 9), np.linspace(-2.0, 2.0, 9), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    corner = np.arange(81).reshape(9, 9)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[1:, :-1].ravel(), corner[1:, 1:].ravel(), corner[:-1, 1:].ravel()
    triangles = vertices[np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])]
    targets = np.concatenate([0.99 * vertices, triangles.mean(1)])
    origins = np.random.default_rng(0).uniform(0.5, 1.5, targets.shape)
    rays = targets - origins
    lengths = np.linalg.norm(rays, axis=1)
    assert triangle_ranges(origins, rays / lengths[:, None], triangles) == pytest.approx(lengths, rel=1e-12)
    assert triangle_ranges(origins[:1], np.array([[0.0, 0.0, 1.0]]), triangles) == [math.inf]


def test_errors_of_known_ranges():
    truth = np.array([1.0, 2.0, 4.0, math.inf, math.inf, 5.0])
    found = errors(np.array([1.0, 2.001, 4.4, math.inf, 3.0, math.inf]), truth)
    assert found.num_rays == 6 and found.disagree == pytest.approx(100.0 / 3.0)
    assert found.median == pytest.approx(5e-4) and found.largest == pytest.approx(0.1)
    assert found.gross == pytest.approx(100.0 / 3.0)


def test_rotations_turn_as_quaternions_do():
    turn = quat_about(np.array([0.0, 0.0, 1.0]), np.array(math.pi / 2))
    assert matrices(turn) @ [1.0, 0.0, 0.0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-15)
    tilt = quat_about(np.array([1.0, 0.0, 0.0]), np.array(0.3))
    assert matrices(quat_multiply(turn, tilt)) == pytest.approx(matrices(turn) @ matrices(tilt), abs=1e-15)


# ---- meshes and memory -----------------------------------------------------------------------------------------------

SIZES = {"box": (0.3, 0.5, 0.4), "sphere": (0.3,), "cylinder": (0.3, 0.5), "capsule": (0.3, 0.5)}
VOLUMES = {"box": 8 * 0.3 * 0.5 * 0.4, "sphere": 4 / 3 * math.pi * 0.027, "cylinder": math.pi * 0.09}
VOLUMES["capsule"] = VOLUMES["sphere"] + VOLUMES["cylinder"]


@pytest.mark.parametrize(("kind", "triangles"), [*((k, None) for k in SIZES), ("sphere", 4096), ("cylinder", 8)])
def test_meshes_are_closed_and_inscribed(kind, triangles):
    vertices, faces = tessellate_to(kind, SIZES[kind], triangles) if triangles else tessellate(kind, SIZES[kind])
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len({tuple(edge) for edge in edges}) == len(edges)  # each way once, so that every edge has two sides
    assert {tuple(edge) for edge in edges} == {tuple(edge) for edge in edges[:, ::-1]}
    a, b, c = vertices[faces].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    least = 1.0 - 1e-9 if kind == "box" else {4096: 0.99, 8: 0.4}.get(triangles, 0.9)
    assert least * VOLUMES[kind] < volume <= VOLUMES[kind] * (1 + 1e-9)  # outward
    assert triangles is None or 0.7 < len(faces) / triangles <= 1.5


def test_shared_buffers_count_once():
    """By hand, also of what is in a Warp struct, in a mesh and behind a view of NumPy's."""
    wp.init()
    tensor = torch.zeros(10, dtype=torch.float32)
    other = torch.zeros(3, dtype=torch.float64)
    holder = [tensor, [tensor[2:], {"x": other}], wp.from_torch(tensor), tensor.numpy()[3:]]
    assert buffer_bytes(holder, tensor) == 40 + 24
    assert buffer_bytes(tensor[2:], tensor.numpy()) == 40
    slots = Slots()
    slots.count = wp.zeros(5, dtype=wp.int32, device="cpu")
    assert buffer_bytes(slots) == 20
    corners = wp.zeros(3, dtype=wp.vec3, device="cpu")
    assert buffer_bytes(wp.Mesh(corners, wp.array([0, 1, 2], dtype=wp.int32, device="cpu"))) == 36 + 12
