"""Files that somebody has made to do harm, names that no file can have, and runs that are killed while they write."""

import functools
import io
import itertools
import json
import os
import random
import signal
import struct
import tracemalloc
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from killed import ends_at

import covocp as co
from covocp.base import archive
from covocp.base.archive import sealed_arrays, sealed_text
from covocp.models import unknown_lag

FORMATS = (".npz", ".json")
needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="the system cannot copy a process")


@pytest.fixture(scope="module")
def lag():
    return co.solve(unknown_lag.problem(), intervals=20, progress=False)


@pytest.fixture(scope="module")
def loop():
    p = co.Problem(duration=1.0, name="loop")
    x = p.state("x", 2, initial=1.0, final=[0.0, None], variance=0.1)
    u = p.control("u", upper=9.0)
    p.dynamics(x, ca_rate(x, u), noise=0.1)
    p.measurement("m", x[0], noise=0.1)
    p.subject_to(x[1] - 9.0, name="lid")
    p.minimize_expected(running=x[0] ** 2 + u**2, terminal_weight={x: 1.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # a coarse mesh is fine here
        return co.evaluate(p, intervals=10)


def ca_rate(x, u):
    import casadi as ca

    return ca.vertcat(x[1], u)


# --- crafted contents -------------------------------------------------------------------------------------------------

JUNK = [
    None, True, 0, -1, 10**6, 10**30, 10**400, 0.5, "", "x", "path", [], [1], ["a", "b"], {}, {"a": 1},
    {"$tuple": []}, {"$tuple": [1, "a"]}, {"$tuple": 3}, {"$map": [[1, 2]]}, {"$map": [[[1], 2]]}, {"$float": "nan"},
    {"$float": "inf"}, {"$float": 3}, {"$float": "nan:00"}, {"$array": "x"}, {"$call": "print"}, {"$a": 1, "$b": 2},
    *(
        {"$array": {"dtype": dtype, "shape": shape, "values": values}}
        for dtype, shape, values in (
            ("<f8", [2], [1, 2]), ("<f8", [], [1]), ("<f8", [0], []), ("<f8", [1, 1, 1], [1]), ("<f8", [2], "ab"),
            ("<f8", [10**12], []), ("<f8", [-1, -1], [1]), ("<f8", [2], [[1, 2], [3]]), ("<f8", [1], ["inf"]),
            ("<i8", [1], [1]), ("<i8", [1], [10**30]), ("O", [1], [1]), ("<U1000000000", [1], ["a"]),
            ("(1000000,1000000)f8", [1], [1]), ("V1000000000", [1], [0]), ("f8,f8", [1], [1]), ("<f8", "a", [1]),
        )
    ),
]  # fmt: skip


def places(tree, path=()):
    """All places in a JSON tree, deep ones of arrays left out."""
    yield path
    if isinstance(tree, dict) and "values" not in tree:
        for key in tree:
            yield from places(tree[key], (*path, key))
    elif isinstance(tree, list):
        for i in range(min(len(tree), 3)):
            yield from places(tree[i], (*path, i))


def looked_at(solution):
    """Everything that a solution without its problem answers."""
    str(solution), repr(solution), solution.cost, solution.status, solution.optimality, solution.smallest_eigenvalue
    for block in solution.blocks:
        solution[block.name]
        for question in (solution.costate, solution.multiplier, solution.deviation, solution.covariance):
            try:
                question(block.name)
            except co.CovocpError:
                continue
    for names in solution.constraints.values():
        for name in names:
            solution.multiplier(name.partition("[")[0])
    if np.isfinite(solution.duration) and solution.duration > 0:
        solution.at(0.3 * solution.duration)
    str(solution.gains)
    solution.to_xarray()


@pytest.mark.parametrize("name", ["lag", "loop"])
def test_whatever_stands_in_a_file_ends_in_an_error_of_our_own_or_in_a_solution(name, request, tmp_path):
    path = request.getfixturevalue(name).save(tmp_path / "solution.json")
    tree = json.loads(path.read_text())
    del tree["checksum"]
    dice = random.Random(5)
    every = [place for place in places(tree) if place]
    read = 0
    for place, junk in itertools.chain(((p, dice.choice(JUNK)) for p in every), random_pairs(dice, every, 60)):
        inside = functools.reduce(lambda part, key: part[key], place[:-1], tree)
        right, inside[place[-1]] = inside[place[-1]], junk
        path.write_bytes(sealed_text(json.dumps(tree)))
        inside[place[-1]] = right
        try:
            with np.errstate(all="ignore"):  # numbers may be inf
                looked_at(co.load(path))
            read += 1
        except co.CovocpError:
            continue
        except Exception as error:
            raise AssertionError(f"{place} = {junk}") from error
    assert 0 < read < len(every)


def random_pairs(dice, every, count):
    return ((dice.choice(every), dice.choice(JUNK)) for _ in range(count))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda tree: tree.update(constraints=3), "wrong type: constraints"),
        (lambda tree: tree["constraints"].pop("end"), "constraints are not those of"),
        (lambda tree: tree["stats"].update(solve_seconds="x"), "wrong type: stats.solve_seconds"),
        (lambda tree: tree["stats"].update(starts=[1, "x"]), "wrong type: stats.starts"),
        (lambda tree: tree["blocks"]["$tuple"][0].update(kind={"$array": 3}), "damaged"),
        (lambda tree: tree["blocks"]["$tuple"][0].update(kind="measurement"), "symbols contradict"),
        (lambda tree: tree["blocks"]["$tuple"][0].update(name="b"), "symbols contradict"),
        (lambda tree: tree["blocks"]["$tuple"][0].update(offset=1), "symbols contradict"),
        (lambda tree: tree["mesh"].update(linear_solver="../../evil"), "mesh contradicts itself"),
        (lambda tree: tree["mesh"].update(step="euler"), "wrong type: mesh.step"),
        (lambda tree: tree.update(filter_gain=tree["targets"]), "wrong shape: filter_gain"),
        (lambda tree: tree["stored_problem"].update(switches=tree["targets"]), "wrong shape: stored_problem"),
    ],
)
def test_what_contradicts_itself_is_said(lag, tmp_path, change, words):
    path = lag.save(tmp_path / "solution.json")
    tree = json.loads(path.read_text())
    del tree["checksum"]
    change(tree)
    path.write_bytes(sealed_text(json.dumps(tree)))
    with pytest.raises(co.ProblemError, match=words):
        co.load(path)


# --- archives ---------------------------------------------------------------------------------------------------------


def entries_of(path):
    with np.load(path) as entries:
        return dict(entries)


def test_entries_that_no_solution_has_are_not_read(lag, tmp_path):
    path = lag.save(tmp_path / "solution.npz")
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as added:
        added.writestr("extra.npy", b"\0" * 2**25)
    tracemalloc.start()
    loaded = co.load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**24
    np.testing.assert_array_equal(loaded["x"], lag["x"])


def test_a_small_file_that_unpacks_to_a_large_array_is_refused_in_bounded_memory(lag, tmp_path, monkeypatch):
    path = lag.save(tmp_path / "solution.npz")
    path.write_bytes(sealed_arrays({**entries_of(path), "rates": np.zeros(2**20)}))
    monkeypatch.setattr(archive, "ALWAYS", 2**20)
    tracemalloc.start()
    with pytest.raises(co.ProblemError, match=r"'rates' unpacks to .* more than a file of"):
        co.load(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**22


def test_the_same_entry_is_not_unpacked_without_end(lag, tmp_path, monkeypatch):
    path = lag.save(tmp_path / "solution.npz")
    entries = entries_of(path)
    document = json.loads(entries.pop("document").tobytes())
    document["stats"] = {str(i): {"$array": "large"} for i in range(1000)}
    text = np.frombuffer(json.dumps(document).encode(), dtype=np.uint8)
    path.write_bytes(sealed_arrays({"document": text, **entries, "large": np.zeros(2**18)}))
    monkeypatch.setattr(archive, "ALWAYS", 2**22)
    with pytest.raises(co.ProblemError, match="'large' unpacks to"):
        co.load(path)


def test_a_large_text_in_a_small_file_is_refused(lag, tmp_path):
    path = lag.save(tmp_path / "solution.npz")
    text = np.frombuffer(b"[" + b"[],"[:3] * 2**22 + b"[]]", dtype=np.uint8)
    path.write_bytes(sealed_arrays({**entries_of(path), "document": text}))
    with pytest.raises(co.ProblemError, match="'document' unpacks to"):
        co.load(path)


def test_headers_that_promise_more_than_there_is_are_refused(lag, tmp_path):
    path = lag.save(tmp_path / "solution.npz")
    names = list(entries_of(path))
    original = path.read_bytes()
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (2**40,)})
    with zipfile.ZipFile(io.BytesIO(original)) as old, zipfile.ZipFile(path, "w") as new:
        for name in names:
            new.writestr(f"{name}.npy", header.getvalue() if name == "rates" else old.read(f"{name}.npy"))
    with pytest.raises(co.ProblemError, match="not what its header says"):
        co.load(path)
    lying = bytearray(original)  # the directory says that the first entry is a byte long
    place = lying.rindex(b"PK\x01\x02", 0, lying.index(b"PK\x01\x02") + 4)
    struct.pack_into("<I", lying, place + 24, 1)
    path.write_bytes(lying)
    with pytest.raises(co.ProblemError, match="damaged"):
        co.load(path)


def test_other_compressions_are_refused(lag, tmp_path):
    path = lag.save(tmp_path / "solution.npz")
    original = path.read_bytes()
    with zipfile.ZipFile(io.BytesIO(original)) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as new:
        for info in old.infolist():
            new.writestr(info.filename, old.read(info))
    with pytest.raises(co.ProblemError, match="compressed in another way"):
        co.load(path)


def test_what_compresses_better_than_is_believed_is_written_so_that_it_can_be_read(lag, tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "ALWAYS", 2**16)
    large = replace(lag, stats={"zeros": np.zeros(2**20)})
    assert co.load(large.save(tmp_path / "large.npz")).stats["zeros"].size == 2**20


# --- names and permissions --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["a" * 300 + ".npz", "a\0b.npz", 3, None, b"x.npz", ["x.npz"], "", "/dev/null"])
def test_names_that_no_file_has_are_refused(lag, tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(co.ProblemError, match="cannot be read as a solution"):
        co.load(path)
    with pytest.raises(co.ExportError, match="cannot be written"):
        lag.save(path)
    assert not list(tmp_path.iterdir())


def test_files_and_folders_that_are_closed_to_us(lag, tmp_path, monkeypatch):
    path = lag.save(tmp_path / "solution.npz")
    before = path.read_bytes()

    def closed(*_, **__):
        raise PermissionError(13, "Permission denied")

    for place, name in ((Path, "read_bytes"), (Path, "stat")):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, closed)
            with pytest.raises(co.ProblemError, match="Permission denied"):
                co.load(path)
    for place, name in ((os, "stat"), (Path, "touch"), (Path, "write_bytes"), (Path, "replace"), (os, "fsync")):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, closed)
            with pytest.raises(co.ExportError, match=r"cannot be written(.|\n)*Permission denied"):
                lag.save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_pipes_are_not_waited_for(tmp_path):
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes")
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(co.ProblemError, match="no ordinary file"):
        co.load(tmp_path / "pipe.npz")


def test_a_full_disk_keeps_the_old_file(lag, tmp_path):
    resource = pytest.importorskip("resource")
    path = lag.save(tmp_path / "solution.json")
    before = path.read_bytes()
    size, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, size[1]))
        with pytest.raises(co.ExportError, match=r"'solution\.json' cannot be written(.|\n)*File too large"):
            replace(lag, name="other").save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, size)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


# --- killed runs ------------------------------------------------------------------------------------------------------


@needs_fork
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_save_that_is_killed_leaves_the_old_or_the_new_file_and_the_next_one_cleans_up(lag, tmp_path, suffix):
    other = co.load(replace(lag, name="other").save(tmp_path / f"new{suffix}"))
    before, after = lag.save(tmp_path / f"old{suffix}").read_bytes(), (tmp_path / f"new{suffix}").read_bytes()
    number, left = 0, 0
    for number in itertools.count(1):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = folder / f"solution{suffix}"
        path.write_bytes(before)
        there = ends_at(number, functools.partial(other.save, path))
        assert path.read_bytes() in (before, after)
        left += len(list(folder.iterdir())) - 1
        other.save(folder / f"another{suffix}")
        assert sorted(entry.name for entry in folder.iterdir()) == [f"another{suffix}", path.name]
        if not there:
            break
    assert path.read_bytes() == after
    assert number > 4
    assert left > 0


def test_a_file_is_on_the_disk_before_it_replaces_the_old(lag, tmp_path, monkeypatch):
    flushed, fsync, rename = [], os.fsync, Path.replace

    def noted(handle):
        fsync(handle)
        flushed.append(os.fstat(handle).st_ino)

    def checked(part, target):
        assert flushed == [part.stat().st_ino]
        return rename(part, target)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(Path, "replace", checked)
    lag.save(tmp_path / "solution.npz")
    assert flushed[1:] == [tmp_path.stat().st_ino]


def test_files_that_another_run_is_writing_are_left_alone(lag, tmp_path):
    from covocp.base.files import written_whole

    with written_whole(tmp_path / "one.npz", FORMATS) as part:
        lag.save(tmp_path / "two.npz")
        assert part.exists()
        part.write_bytes(b"whole")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["one.npz", "two.npz"]
