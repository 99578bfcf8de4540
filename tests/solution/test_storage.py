"""Solutions in files: every bit comes back, nothing is executed, and a bad file says what is wrong."""

import json
import pickle
import sys
import warnings
import zipfile
from dataclasses import fields, is_dataclass, replace

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import covocp as co
from covocp.base.archive import DamagedFileError, decode, encode, sealed_text
from covocp.models import bryson_denham, free_time_integrator, mass_chain, noisy_integrator, unknown_lag
from covocp.solution.storage import from_tree, to_tree

FORMATS = (".npz", ".json")
FIXED = settings(derandomize=True, deadline=None, database=None)


def solve(problem, **options):
    return co.solve(problem, **{"intervals": 12, "progress": False, **options})


PROBLEMS = {
    "estimation": unknown_lag.problem,
    "matrix": noisy_integrator.problem,
    "no matrix": bryson_denham.problem,
    "free time": free_time_integrator.problem,
    "vector states": lambda: mass_chain.problem(2),
}


@pytest.fixture(scope="module", params=PROBLEMS)
def case(request):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", co.CovocpWarning)  # coarse meshes are fine here
        return PROBLEMS[request.param], solve(PROBLEMS[request.param](), intervals=20)


@pytest.fixture(scope="module")
def lag():
    return solve(unknown_lag.problem(), intervals=60)


def assert_same(one, two, place="solution"):
    """Equal to the last bit, types included."""
    assert type(one) is type(two), place
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (two.dtype, two.shape), place
        assert one.tobytes() == two.tobytes(), place
    elif is_dataclass(one):
        for f in fields(one):
            if f.name not in ("stated", "stored_optimality", "stored_costates", "stored_dense", "stored_problem"):
                assert_same(getattr(one, f.name), getattr(two, f.name), f"{place}.{f.name}")
        if isinstance(one, co.Solution):
            assert_same(one.costates, two.costates, f"{place}.costates")
            assert_same(one.dense, two.dense, f"{place}.dense")
    elif isinstance(one, dict):
        assert list(one) == list(two), place
        for key in one:
            assert_same(one[key], two[key], f"{place}.{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(two), place
        for i, (a, b) in enumerate(zip(one, two, strict=True)):
            assert_same(a, b, f"{place}.{i}")
    elif isinstance(one, float):
        assert np.float64(one).tobytes() == np.float64(two).tobytes(), place
    else:
        assert one == two, place


# --- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_entry_comes_back(case, suffix, tmp_path):
    _, solution = case
    path = solution.save(tmp_path / f"solution{suffix}")
    loaded = co.load(path)
    assert_same(solution, loaded)
    assert loaded.statement is None
    assert_same(solution.optimality.as_dict(), loaded.optimality.as_dict())
    for name in solution.values:
        assert_same(solution.values[name], loaded[name])
    assert not loaded.trajectory.x.flags.writeable


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_problem_is_attached_again(case, suffix, tmp_path):
    make, solution = case
    problem = make()
    loaded = co.load(solution.save(tmp_path / f"solution{suffix}"), problem)
    assert loaded.statement is problem.statement()
    key = next(iter(problem.declarations.states)).symbol
    np.testing.assert_array_equal(loaded[key], solution[key.name()])
    doubled = (2 * solution[key.name()]).reshape(loaded.t.size, -1)
    np.testing.assert_allclose(loaded[2 * key].reshape(loaded.t.size, -1), doubled, rtol=1e-15)


def floats(shape):
    """Arrays of any 64 bits: also signed zeros, subnormal numbers, infinities and all kinds of NaN."""
    return hnp.arrays(np.uint64, shape, elements=st.integers(0, 2**64 - 1)).map(
        lambda a: a.view(np.float64)
    ) | hnp.arrays(
        np.float64, shape, elements=st.sampled_from([0.0, -0.0, np.nan, np.inf, -np.inf, 1e308, 5e-324, 0.1])
    )


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | floats((2, 0)) | floats((3,))
    | hnp.arrays(np.int64, 2) | hnp.arrays(np.bool_, (1, 2)) | hnp.arrays(np.float32, 2),
    lambda inner: st.lists(inner, max_size=3)
    | st.lists(inner, max_size=3).map(tuple)
    | st.dictionaries(st.text(max_size=4) | st.sampled_from(["$array", "$map", "a.b"]), inner, max_size=3)
    | st.dictionaries(st.integers(), inner, max_size=2),
    max_leaves=8,
)  # fmt: skip


@FIXED
@given(value=values, aside=st.booleans())
def test_values_come_back(value, aside):
    arrays = {} if aside else None
    text = json.dumps(encode(value, "value", arrays), allow_nan=False)
    assert_same(value, decode(json.loads(text), arrays))


@settings(FIXED, max_examples=25)
@given(data=st.data(), suffix=st.sampled_from(FORMATS))
def test_any_solution_comes_back(lag, tmp_path_factory, data, suffix):
    draw, t = data.draw, lag.trajectory
    changed = replace(
        lag,
        name=draw(st.text(max_size=5)),
        message=draw(st.text(max_size=5)),
        converged=draw(st.booleans()),
        cost_terms={"terminal": draw(st.floats()), "running": draw(st.floats())},
        extremal=replace(
            lag.extremal,
            trajectory=replace(t, x=draw(floats(t.x.shape)), e=draw(floats(t.e.shape)), duration=draw(st.floats())),
            stated=None,
        ),
        rates=draw(floats(lag.rates.shape)),
        filter_gain=draw(st.none() | floats(lag.filter_gain.shape)),
        violations=draw(st.dictionaries(st.text(max_size=5), st.floats(), max_size=3)),
        stats=draw(st.dictionaries(st.text(max_size=5), values, max_size=3)),
        mesh_error=draw(st.floats()),
        stored_costates=lag.costates,
        stored_dense=replace(lag.dense, values=draw(floats(lag.dense.values.shape))),
    )
    path = changed.save(tmp_path_factory.mktemp("any") / f"solution{suffix}")
    assert_same(changed, co.load(path))


def test_a_failed_iterate_is_kept_and_is_a_guess(tmp_path):
    problem = unknown_lag.problem()
    with pytest.raises(co.SolveError) as caught:
        solve(problem, intervals=60, max_iterations=6)
    loaded = co.load(caught.value.solution.save(tmp_path / "iterate.npz"))
    assert not loaded.converged
    assert loaded.status.startswith("NOT CONVERGED")
    solution = solve(problem, intervals=60, guess=loaded)
    assert solution.cost == pytest.approx(6.551062, rel=1e-5)


@pytest.mark.parametrize("covariances", ["eliminated", "states"])
def test_a_file_without_its_problem_is_a_guess_on_any_mesh(lag, tmp_path, covariances):
    problem = unknown_lag.problem()
    options = {"intervals": 97, "covariances": covariances}
    loaded = co.load(lag.save(tmp_path / "lag.npz"))
    near = co.Solver(problem, **options).solve(guess=loaded, iteration_limit=0, assess=False)
    assert near.cost == pytest.approx(lag.cost, rel=1e-4)
    assert near.stats["iterations"] == 0
    assert solve(problem, guess=loaded, **options).cost == pytest.approx(lag.cost, rel=1e-5)


def test_optimality_that_cannot_be_evaluated_does_not_keep_from_saving(lag, tmp_path):
    extremal = replace(lag.extremal, trajectory=replace(lag.trajectory, duration=float("nan")))
    broken = replace(lag, extremal=extremal, stored_optimality=None)
    loaded = co.load(broken.save(tmp_path / "broken.npz"))
    assert np.isnan(loaded.duration)


# --- files that cannot be read ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
@settings(FIXED, max_examples=30)
@given(data=st.data())
def test_truncated_files_are_refused(lag, tmp_path_factory, suffix, data):
    folder = tmp_path_factory.mktemp("cut")
    content = lag.save(folder / f"solution{suffix}").read_bytes()
    path = folder / f"cut{suffix}"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    with pytest.raises(co.ProblemError, match=r"cannot be read as a solution(.|\n)*expected(.|\n)*remedy"):
        co.load(path)


@pytest.mark.parametrize("suffix", FORMATS)
def test_one_flipped_bit_anywhere_is_refused(lag, tmp_path, suffix):
    content = bytearray(lag.save(tmp_path / f"solution{suffix}").read_bytes())
    path = tmp_path / f"flipped{suffix}"
    random = np.random.default_rng(1)
    ends = [*range(8 * len(content) - 1200, 8 * len(content), 7), *range(0, 400, 7)]  # the checksums; the beginning
    for bit in [*random.integers(8 * len(content), size=60), *ends]:
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        content[bit // 8] ^= 1 << bit % 8
        with pytest.raises(co.ProblemError, match="cannot be read as a solution"):
            co.load(path)


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_same_solution_makes_the_same_file(lag, tmp_path, suffix):
    one, two = (lag.save(tmp_path / f"{name}{suffix}").read_bytes() for name in ("one", "two"))
    assert one == two


def test_a_number_changed_by_hand_is_refused(lag, tmp_path):
    path = lag.save(tmp_path / "solution.json")
    path.write_text(path.read_text().replace('"mesh_error": ', '"mesh_error": 1'))
    with pytest.raises(co.ProblemError, match=r"checksum does not fit: it is damaged, or was changed"):
        co.load(path)


def tree_of(path):
    return json.loads(path.read_text(encoding="utf-8"))


def changed(path, change):
    tree = tree_of(path)
    change(tree)
    tree.pop("checksum")
    path.write_bytes(sealed_text(json.dumps(tree)))  # as somebody would who wants it to be read
    return path


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda tree: tree.update(format="other"), "of another format"),
        (lambda tree: tree.update(version=1), "version is 1 and has no checksum"),
        (lambda tree: tree.update(version=2), "version is 2 and has no checksum"),
        (lambda tree: tree.pop("version"), "version is None"),
        (lambda tree: tree.pop("rates"), "lacks the entries rates"),
        (lambda tree: tree["mesh"].pop("nodes"), "lacks the entries mesh.nodes"),
        (lambda tree: tree.update(stored_costates=None), "lacks the entries stored_costates"),
        (lambda tree: tree.update(name=3), "wrong type: name"),
        (lambda tree: tree.update(blocks=[]), "wrong type: blocks"),
        (lambda tree: tree["mesh"].update(substeps=1.5), "wrong type: mesh.substeps"),
        (lambda tree: tree["mesh"].update(segments={"$tuple": [3]}), "mesh contradicts itself"),
        (lambda tree: tree["mesh"]["nodes"]["$array"]["values"].reverse(), "do not rise"),
        (lambda tree: tree["rates"]["$array"].update(shape=[-1]), "wrong shape: rates"),
        (lambda tree: tree["rates"]["$array"].update(dtype="O"), "damaged"),
        (lambda tree: tree["rates"]["$array"].update(dtype="complex128"), "damaged"),
        (lambda tree: tree.update(rates={"$call": "print"}), "damaged"),
        (lambda tree: tree["trajectory"].update(duration={"$float": "ten"}), "damaged"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(lag, tmp_path, change, words):
    path = changed(lag.save(tmp_path / "solution.json"), change)
    with pytest.raises(co.ProblemError, match=words):
        co.load(path)


@pytest.mark.parametrize("content", [b"", b"PK", b"hello", b"[1, 2]", b"null", b'{"a": 1}', b"\xff\xfe", b"[" * 100000])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "other.json"
    path.write_bytes(content)
    with pytest.raises(co.ProblemError, match="cannot be read as a solution"):
        co.load(path)


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(co.ProblemError, match="no such file"):
        co.load(tmp_path / "missing.npz")
    with pytest.raises(co.ProblemError, match="cannot be read"):
        co.load(tmp_path)


def test_other_archives_are_refused(tmp_path):
    np.savez(tmp_path / "arrays.npz", x=np.zeros(3))
    with pytest.raises(co.ProblemError, match="no entry 'document'"):
        co.load(tmp_path / "arrays.npz")
    with zipfile.ZipFile(tmp_path / "archive.npz", "w") as archive:
        archive.writestr("document", "hello")
    with pytest.raises(co.ProblemError, match="cannot be read"):
        co.load(tmp_path / "archive.npz")


class Touch:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_nothing_in_a_file_is_executed(lag, tmp_path):
    trace = tmp_path / "executed"
    entry = np.array([Touch(trace)], dtype=object)
    path = lag.save(tmp_path / "solution.npz")
    with np.load(path) as entries:
        arrays = dict(entries)
    for name in ("document", "trajectory.x", "surprise"):
        np.savez(path, **{**arrays, name: entry})
        with pytest.raises(co.ProblemError, match="damaged"):
            co.load(path)
    (tmp_path / "pickled.npz").write_bytes(pickle.dumps(Touch(trace)))
    with pytest.raises(co.ProblemError, match="damaged"):
        co.load(tmp_path / "pickled.npz")
    assert not trace.exists()


# --- other problems ---------------------------------------------------------------------------------------------------


def test_other_values_of_the_parameters_belong_to_the_same_problem(tmp_path):
    solution = solve(unknown_lag.problem(), intervals=60, parameters={"weight": 1.0})
    loaded = co.load(solution.save(tmp_path / "solution.npz"), unknown_lag.problem())
    assert loaded["weight"][0] == 1.0


# --- writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_failed_save_leaves_the_old_file(lag, tmp_path, suffix):
    path = lag.save(tmp_path / f"solution{suffix}")
    before = path.read_bytes()
    with pytest.raises(co.ExportError, match=r"'stats\.made_by' cannot be written"):
        replace(lag, stats={"made_by": solve}).save(path)
    with pytest.raises(co.ExportError, match="could not be read again"):
        replace(lag, rates=lag.rates[1:]).save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_files_that_cannot_be_written(lag, tmp_path):
    with pytest.raises(co.ExportError, match="suffix names no format"):
        lag.save(tmp_path / "solution.pickle")
    with pytest.raises(co.ExportError, match="folder does not exist"):
        lag.save(tmp_path / "missing" / "solution.npz")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(co.ExportError, match="which is a folder"):
        lag.save(tmp_path / "folder.npz")
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder.npz"]


# --- xarray -----------------------------------------------------------------------------------------------------------


def test_xarray_has_the_values_under_their_names(case):
    _, solution = case
    dataset = solution.to_xarray()
    np.testing.assert_array_equal(dataset["time"], solution.t)
    assert dataset.attrs["cost"] == solution.cost
    for block in solution.blocks:
        constant = block.kind in ("unknown", "parameter")
        expected = solution[block.name][0] if constant else solution[block.name]
        np.testing.assert_array_equal(dataset[block.name], expected)
        if block.kind in ("state", "matrix"):
            np.testing.assert_array_equal(dataset[f"costate_{block.name}"], solution.costate(block.name))
        if block.kind == "matrix":
            assert list(dataset[f"{block.name}_row"].values) == list(block.labels)


def test_xarray_selects_by_name(lag):
    dataset = lag.to_xarray()
    np.testing.assert_array_equal(dataset["E"].sel(E_row="x", E_column="b"), lag["E"][:, 0, 1])
    np.testing.assert_allclose(dataset["deviation_b"] ** 2, lag["E"][:, 1, 1], rtol=1e-14)


def test_without_xarray_the_extra_is_named(lag, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(co.ExportError, match=r"covocp\[xarray\]"):
        lag.to_xarray()


def test_a_file_with_an_unknown_origin_is_refused(lag):
    tree = to_tree(lag)
    assert from_tree(tree).origin == "optimised"
    with pytest.raises(DamagedFileError, match=r"stats\.origin"):
        from_tree({**tree, "stats": {**tree["stats"], "origin": "heaven"}})
