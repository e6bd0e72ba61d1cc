"""`clothgym drape`: exit codes, files, one line for a user's mistake; with a stand-in for dressing, and with the real one."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

import clothgym as cg
import clothgym.dressing
from clothgym import cli
from clothgym.body import Body
from clothgym.commands.drape import FORMATS, encode_mesh

KEYS = {
    *("worn", "at_rest", "hits", "contour_length", "strain_p99", "seam_strain_p99", "penetration_p999"),
    *("penetration_max", "shift", "seconds"),
}
VIEWS = ["front.png", "back.png", "side.png", "views.png"]


@pytest.fixture
def say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Says a command line in an empty folder: exit code, standard output, standard error."""
    entry = EntryPoint("drape", "clothgym.commands.drape:register", cli.ENTRY_POINTS)
    monkeypatch.setattr(cli, "entry_points", lambda: {"drape": entry})
    monkeypatch.delenv("CLOTHGYM_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)

    def say(*words: str) -> Any:
        capsys.readouterr()
        code = cli.main(["drape", *map(str, words)])
        captured = capsys.readouterr()
        return SimpleNamespace(code=code, out=captured.out, err=captured.err)

    return say


class Dressing:
    """Stands in for `clothgym.dressing.drape`: a sheet on a box, in as many attempts as told."""

    def __init__(self) -> None:
        self.asked: dict[str, Any] = {}
        self.worn = True
        self.attempts = 1
        self.steps = 3
        self.interrupt = ""
        self.garment: Any = None

    def __call__(self, pattern: Any, body: Any, **asked: Any) -> Any:
        self.asked = {"pattern": pattern, "body": body, **asked}
        progress, on_step = asked["progress"], asked["on_step"]
        for attempt in range(1, self.attempts + 1):
            text = f"attempt {attempt}, shift +0 mm"
            progress("sew", 1, 2, text)
            if self.interrupt == "sew":
                signal.raise_signal(signal.SIGINT)
            progress("sew", 2, 2, text)
            simulation = self.simulation(body)
            on_step(simulation)
            for step in range(1, self.steps + 1):
                simulation.step()
                if self.interrupt == "drape" and step == 2:
                    signal.raise_signal(signal.SIGINT)
                on_step(simulation)
                progress("drape", step, self.steps, text)
        if self.interrupt == "diverged":
            raise cg.SimulationError("solve", "positions are no longer finite", 0.5, "take more substeps")
        flat = simulation.positions[simulation.faces][:, :, ::2] + 0.25
        self.garment = SimpleNamespace(rest_corners=flat)
        holds = ["left_leg", "right_leg"] if self.worn else []
        report = {
            **dict.fromkeys(KEYS, 0.0),
            **{"worn": self.worn, "at_rest": np.bool_(True), "hits": 0, "shift": np.float64(0.03)},
            "openings": [{"expected": "legs", "through": holds, "right": self.worn}],
        }
        return SimpleNamespace(
            report=report,
            notes=("fit: moved by 3 mm",),
            garment=self.garment,
            body=body,
            simulation=simulation,
            positions=np.array(simulation.positions),
            faces=np.array(simulation.faces),
        )

    def simulation(self, body: Body) -> cg.Simulation:
        flat = cg.grid(0.3, 0.3, 3, 3)
        top = body.mesh.vertices[:, 1].max()
        cloth = cg.Cloth((np.asarray(flat.vertices) + np.array([0.0, top + 0.02, 0.0]), flat.faces), name="skirt")
        return cg.Simulation(cg.Scene((cloth,), bodies=(body,), ground=0.0), fidelity="draft")


@pytest.fixture
def dressing(monkeypatch: pytest.MonkeyPatch) -> Dressing:
    fake = Dressing()
    monkeypatch.setattr(clothgym.dressing, "drape", fake)
    return fake


@pytest.fixture
def figure(tmp_path: Path) -> Path:
    """A body of the user's own: a box, 180 cm tall, z up."""
    box = trimesh.creation.box((40.0, 30.0, 180.0))
    box.apply_translation((0.0, 0.0, 90.0))
    path = tmp_path / "figure.ply"
    box.export(path)
    return path


def test_worn_is_zero_and_everything_is_written(say: Any, dressing: Dressing, figure: Path, tmp_path: Path) -> None:
    words = ("skirt", "--body", figure, "--unit", "cm", "--up", "z", "--no-fit", "--fidelity", "draft", "--edge-length")
    words += (
        "0.03",
        "--material",
        "silk",
        "--seconds",
        "1.5",
        "--out",
        "new/skirt.ply",
        "--body-out",
        "body.glb",
        "--json",
    )
    told = say(*words)
    assert told.code == 0, told.err
    document = json.loads(told.out)
    assert document.keys() >= KEYS
    assert document["worn"] is True and document["at_rest"] is True
    assert document["shift"] == 0.03
    assert document["openings"] == [{"expected": "legs", "through": ["left_leg", "right_leg"], "right": True}]
    assert document["notes"] == ["fit: moved by 3 mm"]
    asked = dressing.asked
    assert asked["pattern"] == "skirt", "what the package drafts is cut to the body, so it goes there by name"
    assert asked["body"].mesh.vertices[:, 1].max() == pytest.approx(1.8)
    given = ("fit", "fidelity", "edge_length", "material", "seconds")
    assert [asked[name] for name in given] == [False, cg.Fidelity.preset("draft"), 0.03, "silk", 1.5]
    assert document["pictures"] == [f"new/skirt_{name}" for name in VIEWS]
    sizes = [Image.open(name).size for name in document["pictures"]]
    assert sizes[:3] == [(600, 900)] * 3
    assert sizes[3][0] > 1800 and sizes[3][1] > 900
    cloth = trimesh.load_mesh(document["out"], process=False)
    assert np.array_equal(cloth.faces, dressing.simulation(asked["body"]).faces)
    body = trimesh.load_mesh(document["body_out"], process=False)
    np.testing.assert_allclose(body.bounds[1] - body.bounds[0], (0.4, 1.8, 0.3), atol=1e-6)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["body.glb", "figure.ply", "new"]


def test_not_worn_is_one_and_everything_is_written_all_the_same(say: Any, dressing: Dressing, figure: Path) -> None:
    pytest.importorskip("rerun")
    dressing.worn = False
    told = say("skirt", "--body", figure, "--unit", "cm", "--out", "skirt.obj", "--record", "a.rrd")
    assert told.code == 1
    assert "skirt on figure: not worn: the opening for legs holds nothing" in told.err
    assert "fit: moved by 3 mm" in told.err
    assert Path("skirt.obj").is_file() and Path("a.rrd").is_file() and Path("skirt_views.png").is_file()
    for word in ("worn", "no", "shift [m]", "0.03", "penetration p999 [m]", "nothing", "skirt.obj", "skirt_views.png"):
        assert word in told.out


def test_pictures_go_where_they_are_asked_for(say: Any, dressing: Dressing, figure: Path) -> None:
    words = ("skirt", "--body", figure, "--unit", "cm", "--json")
    assert json.loads(say(*words).out)["pictures"] == [f"logs/drape/skirt_figure/{name}" for name in VIEWS]
    asked = json.loads(say(*words, "--pictures", "here/pics", "--out", "mesh/a.ply").out)
    assert asked["pictures"] == [f"here/pics/{name}" for name in VIEWS]
    for name in asked["pictures"]:
        assert Path(name).is_file()
    assert [p.name for p in Path("mesh").iterdir()] == ["a.ply"]


def test_the_recording_holds_the_last_attempt(say: Any, dressing: Dressing, figure: Path) -> None:
    pytest.importorskip("rerun")
    from clothgym.recording.rerun_read import read_recording

    dressing.attempts, dressing.steps = 2, 4
    told = say("skirt", "--body", figure, "--unit", "cm", "--record", "drape.rrd", "--json")
    assert told.code == 0, told.err
    found = read_recording("drape.rrd")
    assert found.complete
    assert found.steps.tolist() == [0, 1, 2, 3, 4]
    assert found.sim_time[0] == 0.0
    assert found.bodies["figure"].positions.shape == (1, 8, 3)
    assert {"hits", "contour_length", "penetration_depth"} <= set(found.scalars)
    still = read_recording("drape.rrd").positions(4)
    dressing.attempts = 1
    assert say("skirt", "--body", figure, "--unit", "cm", "--record", "again.rrd").code == 0
    assert np.array_equal(still, read_recording("again.rrd").positions(4))


def test_ctrl_c_while_draping_keeps_the_recording(say: Any, dressing: Dressing, figure: Path) -> None:
    pytest.importorskip("rerun")
    from clothgym.recording.rerun_read import read_recording

    dressing.interrupt = "drape"
    told = say("skirt", "--body", figure, "--unit", "cm", "--record", "a.rrd", "--out", "a.ply", "--json")
    assert told.code == 130
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert "stopped after 0.03 s of draping (attempt 1, shift +0 mm); kept what there is of a.rrd" in told.err
    assert read_recording("a.rrd").steps.tolist() == [0, 1, 2]
    assert not Path("a.ply").exists()


def test_ctrl_c_while_sewing_leaves_nothing(say: Any, dressing: Dressing, figure: Path, tmp_path: Path) -> None:
    dressing.interrupt = "sew"
    told = say("skirt", "--body", figure, "--unit", "cm", "--record", "a.rrd")
    assert told.code == 130
    assert told.err == "clothgym drape: stopped while sewing (attempt 1, shift +0 mm); nothing was written\n"
    assert [p.name for p in tmp_path.iterdir()] == ["figure.ply"]


def test_a_diverged_drape_is_one_line_and_its_recording_is_closed(say: Any, dressing: Dressing, figure: Path) -> None:
    pytest.importorskip("rerun")
    from clothgym.recording.rerun_read import read_recording

    dressing.interrupt = "diverged"
    told = say("skirt", "--body", figure, "--unit", "cm", "--record", "a.rrd")
    assert told.code == 1
    assert "no longer finite" in told.err and told.err.count("\n") == 1
    assert "SimulationError" in read_recording("a.rrd").documents["end"]["failure"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("nothing --body female", r"nothing: no such pattern file, and none of .*skirt"),
        ("half.json --body female", r"half\.json: not valid JSON"),
        ("empty.json --body female", r"empty\.json: .*properties"),
        ("skirt", "--body"),
        ("skirt --body nobody", "nobody: no such file, and no body of the package"),
        ("skirt --body half.obj", r"half\.obj: .*triangle"),
        ("skirt --body female --pose sitting", "pose = 'sitting': expected one of rest, a_pose"),
        ("skirt --body figure.ply --pose a_pose", r"figure\.ply: pose = 'a_pose'"),
        ("skirt --body figure.ply --unit parsec", "unit = 'parsec': expected one of m"),
        ("skirt --body figure.ply --up x", "up = 'x': expected one of y, z"),
        ("skirt --body female --out a.fbx", r"--out = 'a\.fbx': cannot write '\.fbx': expected \.ply, \.obj, \.glb"),
        ("skirt --body female --body-out a", "--body-out = 'a': cannot write a file without ending"),
        ("skirt --body female --out a.ply --body-out a.ply", r"--body-out = 'a\.ply': is --out too"),
        ("skirt --body figure.ply --out figure.ply", r"--out = 'figure\.ply': is --body too"),
        ("skirt --body female --out folder.ply", r"--out = 'folder\.ply': is a folder"),
        ("skirt --body female --out half.json/a.ply", r"half\.json: "),
        ("skirt --body female --record a.mp4", r"a\.mp4.*must end in \.rrd"),
        ("skirt --body female --pictures half.json", r"--pictures = 'half\.json': not a folder"),
        ("skirt --body female --edge-length 0", "--edge-length = 0"),
        ("skirt --body female --seconds -1", "--seconds = -1"),
        ("skirt --body female --seconds nan", "--seconds = nan"),
        ("skirt --body female --material velvet", "--material = 'velvet': expected one of cotton"),
        ("skirt --body female --fidelity fast", "fidelity = 'fast'"),
        ("skirt --body female --animate dance", "--animate = 'dance': expected one of walk"),
        ("skirt --body female --frames a.npy", "body 'female': frames and rate are for mesh files"),
        ("skirt --body figure.ply --frames a.npy", r"a\.npy: no such file"),
        ("skirt --body figure.ply --frame-rate 10", r"figure\.ply: one mesh; a sequence needs frames"),
        ("skirt --body folder.ply", r"folder\.ply: 0 mesh files"),
        ("skirt --body female --mesher hexagons", "--mesher = 'hexagons'"),
        ("skirt --body female --mesher quads --grid 12", "--grid = '12': expected columns x rows"),
        ("skirt --body female --closing glue", "--closing = 'glue'"),
    ],
)
def test_bad_input_is_one_line(
    say: Any, dressing: Dressing, figure: Path, tmp_path: Path, words: str, message: str
) -> None:
    (tmp_path / "half.json").write_text("{")
    (tmp_path / "empty.json").write_text('{"pattern": {}}')
    (tmp_path / "half.obj").write_text("v 0 0 0\n")
    (tmp_path / "folder.ply").mkdir()
    before = sorted(tmp_path.iterdir())
    told = say(*words.split())
    assert told.code == 2, told.err
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert told.err.startswith("clothgym drape: ")
    assert re.search(message, told.err), told.err
    assert dressing.asked == {}, "told before the work"
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("ending", FORMATS)
def test_written_meshes_are_read_back(tmp_path: Path, ending: str) -> None:
    mesh = cg.grid(0.4, 0.3, 3, 2)
    vertices = np.asarray(mesh.vertices) + 1.0 / 3.0
    path = tmp_path / f"mesh.{ending.upper()}"
    path.write_bytes(encode_mesh(path, vertices, mesh.faces, vertices[mesh.faces][:, :, ::2]))
    found = trimesh.load_mesh(path, process=False, file_type=ending, maintain_order=True, skip_materials=True)
    np.testing.assert_allclose(found.triangles, vertices[mesh.faces], atol=1e-6)
    if ending not in ("stl", "obj"):  # no vertices in common there; a texture cuts what trimesh reads
        assert len(found.vertices) == len(vertices)


def test_an_obj_keeps_the_flat_pattern_and_whole_seams(tmp_path: Path) -> None:
    """Two triangles sewn along an edge, whose vertices lie in two places of the pattern; every bit survives."""
    rng = np.random.default_rng(5)
    vertices, faces = rng.normal(size=(4, 3)), np.array([(0, 1, 2), (2, 1, 3)], np.int32)
    flat = rng.normal(size=(2, 3, 2))
    lines = [line.split() for line in encode_mesh(tmp_path / "a.obj", vertices, faces, flat).decode().splitlines()]
    read = {kind: [line[1:] for line in lines if line[0] == kind] for kind in ("v", "vt", "f")}
    assert np.array_equal(np.array(read["v"], float), vertices)
    corners = np.array([[corner.split("/") for corner in face] for face in read["f"]], int) - 1
    assert np.array_equal(corners[:, :, 0], faces)
    assert np.array_equal(np.array(read["vt"], float)[corners[:, :, 1]], flat)
    assert len(read["vt"]) == 6


def test_a_real_skirt_on_a_real_body(say: Any) -> None:
    """Coarse and quick; not the quality of the drape is tested here, but that the command fits what it calls."""
    words = ("skirt", "--body", "female", "--pose", "a_pose", "--fidelity", "draft", "--edge-length", "0.05")
    told = say(*words, "--out", "skirt.obj", "--body-out", "woman.ply", "--json")
    assert told.code == 0, told.err
    document = json.loads(told.out)
    assert document.keys() >= KEYS | {"attempts", "mean_speed", "p99_speed", "simulated_seconds", "vertices", "faces"}
    assert document["worn"] is True
    assert [o["expected"] for o in document["openings"]] == ["legs", "legs"]
    cloth = trimesh.load_mesh("skirt.obj", process=False, maintain_order=True, skip_materials=True)
    body = trimesh.load_mesh("woman.ply", process=False)
    assert (len(cloth.faces), len(body.vertices)) == (document["faces"], 13380)
    assert body.bounds[0][1] < cloth.bounds[0][1] < cloth.bounds[1][1] < body.bounds[1][1]
    hem = trimesh.load_mesh("skirt.obj", process=True)
    assert hem.euler_number == 0, "an open tube: its seams are closed in the file"
