"""What users bring: each wrong input gets one sentence with its place, before anything is simulated, or the right
result."""

from __future__ import annotations

import datetime
import decimal
import re
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import search_fake
from command import call, json_of
from conftest import shared_simulator
from sweep_fake import FakeSimulator
from tiers import needs

from nermo_mjx import Run, Setup, Simulator, all_metrics, all_parameters, load_robot
from nermo_mjx.optimize import Tuning, run_search
from nermo_mjx.optimize.run import tuning_forecasts
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.rollout.setup import TAKEN
from nermo_mjx.runs import JobFailed
from nermo_mjx.sweep import Sweep, run_sweep

BOUND = (Path(__file__).parents[1] / "docs" / "howto" / "controllers" / "bound.py").read_text()


def refused(act: Any, message: str, *given: Any) -> None:
    with pytest.raises(ParameterError) as error:
        act(*given)
    said = str(error.value)
    assert re.search(message, said), said
    assert "\n" not in said


# --- columns of tables


def test_no_parameter_has_the_name_of_another_column() -> None:
    names = set(all_parameters())
    assert not names & (set(all_metrics()) | TAKEN)
    assert "commanded_speed" in names
    for form in (
        {"vary": {"speed": [0.05, 0.1]}},
        {"rows": [{"speed": 0.1}]},
        {"randomize": {"speed": {"uniform": [0, 1]}}},
    ):
        refused(Sweep.from_dict, "field 'speed' is a (metric, and not a parameter|column of results)", form)


@pytest.mark.parametrize("name", ["speed", "row", "seed", "status", "variant", "repeat", "code", "repeats", "gait"])
def test_a_controllers_parameter_may_not_take_a_columns_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "own.py").write_text(
        BOUND.replace("    lag: Any", f"    {name}: Any = quantity(0.1, '1', 0, 1, 'x')\n    lag: Any")
    )
    (tmp_path / "s.yaml").write_text(f"controller: own.py:Bound\nvary: {{{name}: [0.2, 0.4]}}\n")
    refused(Sweep.from_file, f"s.yaml:1: field 'controller' has a parameter '{name}', which is", tmp_path / "s.yaml")


@pytest.mark.compiles
@pytest.mark.parametrize(
    ("name", "short"), [("trot", "trot"), ("walking_trot", "walking_trot"), ("lateral_walk", "lateral_walk")]
)
def test_gaits_have_the_names_of_the_field(name: str, short: str) -> None:
    assert Setup(gait=name) == Setup(gait=short)
    assert Sweep.from_dict({"gait": name, "vary": {"frequency": [0.6]}}).setup.gait == short
    refused(Sweep.from_dict, f"field 'gait' lists {short} twice", {"vary": {"gait": [name, short]}})
    done = call("walk", "--gait", name, "--cycles", "0.1", "--warmup", "0")
    assert done.exit_code == 0, done.output
    assert f"{name.replace('_', ' ')} at 0.67 Hz" in done.output


# --- controllers

UPDATE = (
    "        phase = (phase + params.frequency * self.dt) % 1.0\n        return phase, self.servos(params, phase)\n"
)
#: What is replaced in `bound.py`, by what, and what is said of it.
CONTROLLERS = {
    "nothing": (UPDATE, "        pass\n", r"update \(own.py:39\), which gives NoneType: expected two"),
    "no servos": (UPDATE, "        return phase\n", r"update .*which gives one number of type float32: expected two"),
    "three": (UPDATE, "        return phase, phase, phase\n", "which gives tuple: expected two"),
    "no angles": (UPDATE, "        return phase, jnp.zeros(8)\n", r"an array of shape \(8,\): expected ServoAngles"),
    "raises": (UPDATE, "        raise RuntimeError('boom')\n", "update .* fails at own.py:40: RuntimeError: boom"),
    "if": (UPDATE, "        if phase > 0.5: pass\n" + UPDATE, "at own.py:40: it cannot be compiled"),
    "numpy": (UPDATE, "        import numpy\n        numpy.asarray(phase)\n" + UPDATE, "at own.py:41: it cannot be"),
    "range": (UPDATE, "        for i in range(phase): pass\n" + UPDATE, "at own.py:40: (it cannot be|TypeError)"),
    "sensor": (UPDATE, "        sensors.gyros\n" + UPDATE, "at own.py:40: AttributeError.*did you mean 'gyro'"),
    "whole start": (
        "        return phase\n\n    def initial",
        "        return 0\n\n    def initial",
        "makes float32 of the state, which init begins as int32",
    ),
    "truth start": (
        "        return phase\n\n    def initial",
        "        return True\n\n    def initial",
        "makes float32 of the state, which init begins as bool",
    ),
    "NaN start": (
        "        return phase\n\n    def initial",
        "        return phase / phase\n\n    def initial",
        "init .*, which gives nan for a robot at rest",
    ),
    "NaN servos": ("params.reach * jnp.cos", "jnp.nan * jnp.cos", r"initial_servo .*, which gives \[nan.*at rest"),
    "signature": ("def init(self, params, sensors, phase)", "def init(self, params, sensors)", "fails: TypeError"),
    "NaN rate": ("        return params.frequency", "        return jnp.sqrt(-params.lag)", "cycle_rate .*gives nan"),
    "no rate": ("        return params.frequency", "        return None", "cycle_rate .*which gives NoneType"),
    "rate by if": (
        "        return params.frequency",
        "        return 1.0 if params.frequency > 1 else 2.0",
        "cycle_rate .*it cannot be compiled",
    ),
    "no time": ("dt = 0.01", "dt = 0.0", "dt 0.0: expected the seconds of a tick"),
    "NaN time": ("dt = 0.01", "dt = float('nan')", "dt nan: expected the seconds of a tick"),
    "text time": ("dt = 0.01", "dt = '10 ms'", "dt '10 ms': expected the seconds of a tick"),
    "class": ("parameters = Parameters()", "parameters = Parameters", "has parameters with <class.*parameter_tree"),
    "maker": ("    dt = 0.01", "    dt = 0.01\n    def __init__(self): 1 / 0", "at own.py:24: ZeroDivisionError"),
    "arguments": ("    dt = 0.01", "    dt = 0.01\n    def __init__(self, gain): ...", "cannot be made without arg"),
    "other state": (UPDATE, "        return (phase, phase), self.servos(params, phase)\n", "which makes a state of"),
    "import": ("import jax.numpy as jnp", "import jax.numpy as jnp; exit(3)", "imported at own.py:5: SystemExit"),
}


@pytest.mark.compiles
@pytest.mark.parametrize("case", CONTROLLERS)
def test_a_wrong_controller_is_refused_with_file_and_line(tmp_path: Path, case: str) -> None:
    old, new, message = CONTROLLERS[case]
    assert BOUND.count(old) == 1
    (tmp_path / "own.py").write_text(BOUND.replace(old, new))
    (tmp_path / "s.yaml").write_text("vary: {frequency: [1.0, 1.5]}\ncontroller: own.py:Bound\n")
    refused(Sweep.from_file, f"s.yaml:2: field 'controller' .*{message}", tmp_path / "s.yaml")


@pytest.mark.compiles
@pytest.mark.parametrize("engine", ["c", pytest.param("mjx", marks=pytest.mark.long)])
def test_angles_that_become_nan_are_a_divergence(tmp_path: Path, engine: str) -> None:
    """Whether servos, and not only the body, lose their numbers."""
    late = UPDATE.replace("self.servos(params, phase)", "self.servos(params, jnp.sqrt(params.lag - phase) ** 2)")
    (tmp_path / "own.py").write_text(BOUND.replace(UPDATE, late))
    simulator = Simulator(Setup(controller=f"{tmp_path / 'own.py'}:Bound", physics="fast"), engine=engine)
    result = simulator.run({"lag": [0.0001, 1.0]}, Run(duration=0.2))
    assert result.status.tolist() == ["diverged", "ok"]


# --- what rows derive


def test_derived_values_are_refused_at_the_field_that_was_written(tmp_path: Path) -> None:
    refused(
        Sweep.from_text, r"^x:2: field 'duty' is 0.005: allowed is \[0.01, 1\)", "vary:\n  duty: [0.5, 0.6, 0.005]", "x"
    )
    own = BOUND + "\n    def complete(self, values):\n        return {'lag': 1 / values.get('reach', 1.0), **values}\n"
    own += (
        "\n\nclass Root(Bound):\n    def cycle_rate(self, params):\n        return jnp.sqrt(params.frequency - 1.0)\n"
    )
    (tmp_path / "own.py").write_text(own)
    for name, varied, message in (
        ("Bound", "reach: [0.01, 0.05]", "field 'reach' is 0.01, with which lag is 100: allowed is "),
        (
            "Root",
            "frequency: [1.5, 0.5, 2.0]",
            "field 'frequency' is 0.5, with which controller has cycle_rate .* gives nan",
        ),
    ):
        path = tmp_path / "s.yaml"
        path.write_text(f"controller: own.py:{name}\nvary:\n  {varied}\n")
        refused(Sweep.from_file, f"s.yaml:3: {message}", path)
    # Among others in a grid, and out of range only together.
    grid = "vary:\n  stance.front_z: [-0.05, -0.06]\n  stride: [0.2, 1.0]\n  contact.friction: [1, 2]"
    refused(Sweep.from_text, "^x:[23]: field 'st.* reach a stride of 0.030 m", grid, "x")


# --- tables of rows


@pytest.mark.parametrize(
    ("column", "message"),
    [
        ({"gait": [datetime.date(2020, 1, 1)]}, "row 0: field 'gait' is date .*expected a name"),
        ({"gait": [decimal.Decimal("1.0")]}, "'gait' is Decimal"),
        ({"gait": [b"trot"]}, "'gait' is bytes b'trot': expected a name"),
        ({"gait": [["trot"]]}, "'gait' is the list .*: expected a name"),
        ({"frequency": [True]}, "'frequency' is the truth value true: expected a number"),
        ({"frequency": [b"0.8"]}, "'frequency' is bytes b'0.8': expected a number"),
        ({"frequency": [datetime.datetime(2020, 1, 1)]}, "'frequency' is datetime .*expected a number"),
        ({"frequency": [datetime.timedelta(1)]}, "'frequency' is timedelta"),
    ],
)
def test_columns_of_other_types_are_refused(tmp_path: Path, column: Any, message: str) -> None:
    pq.write_table(pa.table(column), tmp_path / "rows.parquet")
    refused(Sweep.from_rows, message, tmp_path / "rows.parquet")


def test_decimals_are_numbers_and_a_column_twice_is_not(tmp_path: Path) -> None:
    pq.write_table(pa.table({"frequency": [decimal.Decimal("0.8"), None]}), tmp_path / "a.parquet")
    assert Sweep.from_rows(tmp_path / "a.parquet").rows.values["frequency"].tolist() == [0.8, 0.67]
    twice = pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], names=["frequency", "frequency"])
    pq.write_table(twice, tmp_path / "b.parquet")
    refused(Sweep.from_rows, "column 'frequency' stands twice", tmp_path / "b.parquet")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frequency;stride\n0,8;1,0\n", "rows.csv:1: columns are separated by ';': allowed is ','"),
        ("frequency\tstride\n0.8\t1\n", r"rows.csv:1: columns are separated by '\\t'"),
        ("frequency|stride\n", r"rows.csv:1: columns are separated by '\|'"),
        ("frequency,stride\n0,8,1,0\n", "rows.csv:2: has 4 values, .*decimal comma"),
        ('frequency\n"0,8"\n', "rows.csv:2: .* is the text '0,8': expected a number with a point"),
    ],
)
def test_semicolons_and_decimal_commas_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "rows.csv").write_text(text)
    refused(Sweep.from_rows, message, tmp_path / "rows.csv")


# --- YAML


PAIRS = ("ab", "bc", "cd", "de")
MERGED = (
    "a: &a {" + ", ".join(f"k{i}: 1" for i in range(300)) + "}\n" + "".join(f"b{i}: {{<<: *a}}\n" for i in range(400))
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "a: &a [x]\n" + "".join(f"{b}: &{b} [{', '.join(['*' + a] * 60)}]\n" for a, b in PAIRS),
            "^x:1: aliases stand for more than 100,000 values",
        ),
        (MERGED, "aliases stand for more than"),
        ("run: {duration: 1}\nset: " + "[" * 900, "^x:2: .*too deep in one another"),
        ("set: " + "[" * 30_000, "^x:1: .*too deep"),
        ("set: " + "{a: " * 900, "^x:1: .*too deep"),
        ("\n".join(" " * i + "a:" for i in range(900)), "^x:900: .*too deep"),
        (
            "run: {duration: 1e30, warmup: 0.5}\nvary: {frequency: [0.6]}",
            r"^x:1: field 'run.duration' is 1e\+30: allowed is \(0, 100000\]",
        ),
        ("run: {cycles: 1e30}\nvary: {frequency: [0.6]}", "field 'run.cycles' is"),
        ("pilot: {straight: {distance: 1e30}}\nvary: {frequency: [0.6]}", "field 'pilot.straight.distance' is"),
        ("vary: {frequency: [" + "1" * 400 + "]}", "field 'frequency' is the number 111"),
    ],
)
def test_files_without_end_are_refused(text: str, message: str) -> None:
    refused(Sweep.from_text, message, text, "x")


# --- scenes


def scene(option: str = "", more: str = "") -> str:
    floor = '<geom name="floor" type="plane" size="0 0 0.1"/>'
    return f"<mujoco>{option}<worldbody>{floor}{more}</worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (scene('<option density="1000" viscosity="0.001"/>'), "its option has density 1000.*only gravity is taken"),
        (scene('<option wind="1 0 0"/>'), "its option has wind"),
        (scene('<option viscosity="0.1"/>'), "its option has viscosity"),
        (scene('<option><flag contact="disable" gravity="disable"/></option>'), "its option has flags"),
        (scene('<option><flag override="enable"/></option>'), "its option has flags"),
        (scene().replace('0.1"/>', '0.1" pos="0 0 nan"/>'), "numbers that are not finite, in geom_pos"),
        (scene(more='<camera name="track_side"/>'), "track_side"),
    ],
)
def test_a_scene_says_what_of_it_is_not_taken(text: str, message: str) -> None:
    refused(lambda: Setup(scene=text), message)


def test_a_scenes_solver_is_warned_of_and_its_gravity_taken() -> None:
    option = '<option timestep="0.01" integrator="RK4" gravity="0 0 -1.62" cone="elliptic"/>'
    with pytest.warns(UserWarning, match="its option has cone 1, integrator 1, timestep 0.01, which is not taken"):
        model = Setup(scene=scene(option)).load().model
    assert (model.opt.timestep, model.opt.gravity[2], model.opt.integrator) == (0.002, -1.62, 0)


@pytest.mark.parametrize("name", ["imu", "torso", "front_left_axis"])
def test_a_scene_may_have_names_of_the_robot(name: str) -> None:
    """On sites and bodies, which nothing of a scene refers to; the robot stands where it does without them."""
    box = '<geom type="box" size="0.1 0.1 0.1"/>'
    model = Setup(scene=scene(more=f'<site name="{name}"/><body name="{name}" pos="3 0 0">{box}</body>')).load().model
    plain = load_robot().model
    assert model.nbody == plain.nbody
    np.testing.assert_allclose(model.body("torso").pos, plain.body("torso").pos)
    np.testing.assert_allclose(model.geom_pos[1], [3, 0, 0])


# --- the robot


class Broker(threading.Thread):
    """Answers, takes messages for a while, and is gone."""

    def __init__(self, life: float) -> None:
        super().__init__(daemon=True)
        self.socket, self.life, self.got = socket.create_server(("127.0.0.1", 0)), life, b""
        self.port = self.socket.getsockname()[1]
        self.start()

    def run(self) -> None:
        peer, _ = self.socket.accept()
        self.got = peer.recv(1024)
        peer.sendall(bytes([0x20, 2, 0, 0]))
        peer.settimeout(self.life)
        gone = threading.Timer(self.life, lambda: peer.shutdown(socket.SHUT_RDWR))
        gone.start()
        while peer.recv(4096):
            pass
        peer.close()
        self.socket.close()


@pytest.mark.process
def test_a_broker_that_goes_away_is_noticed_and_the_password_unquoted() -> None:
    pytest.importorskip("paho.mqtt.client")
    broker = Broker(0.5)
    url = f"mqtt://us%40er:p%2Fss@127.0.0.1:{broker.port}"
    done = run_command(["servos", "--channels", "published", "--seconds", "2", "--send", url])
    assert done.returncode == 1, done.stderr
    sent, lost = map(int, re.search(r"broker is gone: (\d+) messages were sent, (\d+) were not", done.stderr).groups())
    assert sent > 3
    assert lost > 20
    assert b"us@er\x00\x04p/ss" in broker.got


def test_a_bridge_that_goes_away_is_noticed() -> None:
    from websockets.sync.server import serve

    from nermo_mjx import servo_table
    from nermo_mjx.hardware import connected, send_table

    def leave(peer: Any) -> None:
        for _ in range(6):
            peer.recv()

    with serve(leave, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        address = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        with (
            pytest.raises(ParameterError, match=r"server is gone: \d+ messages were sent, \d+ were not"),
            connected(address) as send,
        ):
            send_table(servo_table(channels="published"), send, 2.0)
        server.shutdown()
        thread.join(10)


@pytest.mark.parametrize("scheme", ["mqtt", "ws"])
@pytest.mark.parametrize(
    "address",
    [
        "u:s3cret@h:99999",
        "u:s3cret/x@h",
        "u:s3#cret@h",
        ":s3cret@h",
        "u:x@s3cret@h:0",
        "u:s3cret@[::1",
        "u:s3cret@127.0.0.1:9",
        "s3cret@127.0.0.1:9",
    ],
)
def test_no_password_is_repeated(scheme: str, address: str) -> None:
    pytest.importorskip("paho.mqtt.client")
    from nermo_mjx.hardware import connected

    for url in (f"{scheme}://{address}", f"{scheme}s://{address}", address):
        with pytest.raises(ParameterError) as error:
            connected(url).__enter__()
        assert "s3" not in str(error.value)
        assert "cret" not in str(error.value)


# --- disks and names


def run_command(words: list[str], **given: Any) -> Any:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.run([sys.executable, "-m", "nermo_mjx", *words], text=True, check=False, **pipes | given)


@pytest.mark.process
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize(("stream", "code"), [("stdout", 1), ("stderr", 0)])
def test_a_full_disk_under_the_log_stops_nothing(tmp_path: Path, stream: str, code: int) -> None:
    """What is left to do is the summary, so that the process simulates nothing."""
    (tmp_path / "s.yaml").write_text("vary: {frequency: [0.6, 0.8]}\nrun: {duration: 0.1}\nplots: false\n")
    run_sweep(tmp_path / "s.yaml", tmp_path / "out", simulator=FakeSimulator(engine="c"))
    (tmp_path / "out" / "summary.json").unlink()
    with open("/dev/full", "w") as full:
        done = run_command(["sweep", str(tmp_path / "s.yaml"), "--out", str(tmp_path / "out")], **{stream: full})
        assert done.returncode == code
        assert (tmp_path / "out" / "summary.json").exists()
        assert stream == "stderr" or "done, but standard output cannot be written: No space left" in done.stderr
        assert run_command(["--help"], **{stream: full}).returncode == code
        assert run_command(["nonsense"], **{stream: full}).returncode == 2


def test_a_name_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    from nermo_mjx.runs.files import make_writable

    name = b"gr\xf6\xdfe".decode(errors="surrogateescape")
    for words in (["sweep", "s.yaml", "--out", name], ["status", name]):
        done = call(*words)
        assert done.exit_code == 2
        assert r"'gr\udcf6\udcdfe' is not UTF-8: rename" in done.stderr
    with pytest.raises(RuntimeError, match="is not UTF-8"):
        make_writable(tmp_path / name)
    assert not list(tmp_path.iterdir())


# --- searches, tunings, environments


@pytest.mark.parametrize(
    "aim",
    [
        {"objective": {"minimize": "turning_radius"}},
        {"pareto": [{"maximize": "speed"}, {"minimize": "turning_radius"}]},
    ],
)
def test_an_objective_that_is_nan_is_told_after_the_first_batch(tmp_path: Path, aim: Any) -> None:
    class Straight(search_fake.FakeSimulator):
        def run(self, *given: Any, **named: Any) -> Any:
            result = super().run(*given, **named)
            result.metrics["turning_radius"] = np.full(len(result.status), np.nan)
            return result

    needs(*["pymoo"] * ("pareto" in aim))
    simulator = Straight()
    with pytest.raises(JobFailed, match=r"turning_radius has no number in all .* the first batch .*NaN if straight"):
        run_search(search_fake.WALK | aim | {"budget": 120, "batch": 12}, tmp_path, simulator=simulator)
    assert sum(simulator.batches) <= 24, "its first batch is twice as large"


@pytest.mark.compiles
def test_a_dry_run_refuses_the_recording_that_the_run_refuses(tmp_path: Path) -> None:
    shared_simulator(engine="c").run({}, Run(duration=0.2), record=True).recording().save(tmp_path / "short.npz")
    (tmp_path / "text.npz").write_text("no recording")
    for name, message in (
        ("short.npz", "expected all of the run, from its start to 1 s"),
        ("text.npz", "recording is"),
    ):
        tuning = {
            "objective": [{"minimize": "trajectory_error"}],
            "recording": str(tmp_path / name),
            "run": {"duration": 1.0},
            "tune": {"stride": {"bounds": [0.5, 1.0]}},
        }
        refused(lambda given=tuning: tuning_forecasts(Tuning.from_dict(given)), message)


@pytest.mark.compiles
def test_seeds_beyond_32_bits_are_others_and_masks_are_refused() -> None:
    pytest.importorskip("gymnasium")
    from nermo_mjx.learn import Task
    from nermo_mjx.learn.gymnasium_door import NermoVectorEnv

    task = Task(episode_length=0.1, randomize={"start.phase": (0.0, 1.0)})
    env = NermoVectorEnv(setup=Setup(physics="fast"), worlds=2, task=task)
    first, second = (env.reset(seed=seed)[0] for seed in (0, 2**32))
    assert (first != second).any()
    np.testing.assert_array_equal(first, env.reset(seed=np.int64(0))[0])
    for seed in (2**64, -1, 0.5, "1", [], [-1]):
        refused(lambda given=seed: env.reset(seed=given), "seed (is .*from 0 to 2.64|has [01] entr)")
    refused(
        lambda: env.reset(options={"reset_mask": np.array([True, False])}), "options has reset_mask: none are known"
    )


@pytest.mark.compiles
def test_how_strides_vary_with_the_soles_radius_has_a_command(tmp_path: Path) -> None:
    """A user's sweep: what `compare` says of strides is what pandas finds between touch-downs of the saved series."""
    (tmp_path / "sv.yaml").write_text(
        "gait: trot\nspine: stride_extension\nrun: {cycles: 8, warmup_cycles: 2}\nset: {frequency: 0.8}\n"
        "vary: {geometry.foot.radius: [0.002, 0.004]}\n"
        "save: {sensors: [foot_position, foot_force], rate: 100}\nplots: false\n"
    )
    out = tmp_path / "sv"
    assert call("sweep", tmp_path / "sv.yaml", "--out", out).exit_code == 0
    series = pq.read_table(out / "series").to_pandas()
    expected = []
    for _, walk in series[series.time > 2.5].groupby("row"):
        on = (walk.rear_left_foot_force > 0.02).to_numpy()
        places = walk.rear_left_foot_position_y.to_numpy()[np.flatnonzero(on[1:] & ~on[:-1]) + 1]
        lengths = -np.diff(places)
        expected.append(lengths[lengths > 0.02].mean())
    told = json_of("compare", out, "--by", "geometry.foot.radius", "--metric", "stride_length")
    line = told["metrics"]["stride_length"]
    assert [line["base_mean"], line["other_mean"]] == pytest.approx(expected, rel=0.01)
    shown = call("compare", out, "--by", "geometry.foot.radius", "--metric", "stride_length_cv", "--all").output
    assert re.search(r"stride_length_cv\s+1\s+0\.00\d+\s+0\.00\d+", shown), shown
    assert "which tells no noise; give repeats" in shown
