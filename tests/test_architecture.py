"""Rules of the packages and folders: which file may import which, and what may be in one place only.

docs/explanation/architecture.md describes them. Every import counts, also one inside a function or under TYPE_CHECKING.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PARTS = ("protocol", "workers", "learner")
"""the packages of millrace that stand beside its folder, which has links to them"""
PACKAGES = (*PARTS, "millrace")
FORBIDDEN = {
    "protocol": {"workers", "learner", "millrace"},
    "workers": {"learner", "millrace"},
    "learner": {"workers", "millrace"},
    "millrace": {"benchmarks", "tests"},
}
COMMAND_LINES = "millrace.flags."
"""What every command line is made with, those of learner and workers too: they may import it. It imports only protocol."""
LEARNER = {  # what each folder of the learner may import of the learner; train.py, run.py and the like may import all
    "config": {"run_folder"},
    "algorithms": {"config"},
    "between_updates": {
        "algorithms",
        "callbacks",
        "config",
        "rollouts",
        "run_folder",
        "run_state",
    },
    "callbacks": {"config", "run_folder"},
    "algorithm_check": {"algorithms", "config", "torch_setup", "written_state"},
    "members": set[str](),
    "rollouts": {"members", "run_folder"},
    "shards": {"algorithms", "config", "interrupts", "run_folder", "torch_setup"},
    "vector_env": {"members"},
    "run_folder": {"written_state"},
}
WORKERS = {  # the same for each folder and file of the workers; the files that are not named stand above all of these
    "activity": set[str](),
    "exit_codes": set[str](),
    "shared_weights": set[str](),
    "machine_slots": set[str](),
    "watchdog": set[str](),
    "conversation": {"exit_codes"},
    "supervise": {"activity", "exit_codes", "shared_weights", "machine_slots", "watchdog"},
    "copy_slots": {"activity", "machine_slots"},
    "copies": {"activity", "copy_slots"},
    "acting": {"activity"},
    "opponents": {"acting", "activity"},
    "lanes": {"acting", "activity", "copies", "opponents"},
    "collect": {"activity", "acting", "conversation", "copies", "copy_slots", "lanes", "opponents"},
    "evaluate": {"acting", "activity", "copies", "copy_slots", "lanes", "opponents"},
    "vector_env": {"activity", "copies", "copy_slots"},
}
MILLRACE = {  # the same for each folder of the public package
    "cli": {"flags", "launch", "planning", "play_flags", "playing", "terminal"},
    "flags": set[str](),
    "launch": {"arguments", "flags", "own_policy", "policies", "terminal"},
    "planning": {"arguments", "launch", "policies", "rollout_service"},
}
ROOMS = {"learner": LEARNER, "workers": WORKERS, "millrace": MILLRACE}
MAY_PRINT = ("millrace/cli/", "millrace/terminal.py")
COMMAND_OF_EXTRA = "/command.py"  # it may print, too
MAY_UNPICKLE = {"protocol/env_spec.py"}
ENVIRONMENT_CODE = {"make", "make_vec", "make_vectorized", "registered", "make_native", "envpool_spec"}
"""functions that run code of the environment: of gymnasium, of `EnvSpec` and of the extra `envs`"""
TORCH_IN_PROTOCOL = "protocol/policy/"
TORCH_IN_EXTRAS = "millrace/extras/datasets/cloning.py"
TORCH_INTERNALS = "learner/algorithms/kernels/"
CONFORMANCE = "millrace/extras/conformance/"
CHECKS_A_CLIENT = CONFORMANCE + "conform.py"
RANDOM_STREAMS = "protocol/random_streams.py"
HAS_RANDOM_NUMBERS_OF_ITS_OWN = (  # from constants, not from a run's seed
    "learner/algorithm_check/",
    CONFORMANCE,
)
MAY_SLEEP = ("tests/system/", "tests/support/envs/toy.py")  # the second in `step`: environments that are slow or hang
SLOW_TO_IMPORT = {"torch", "PIL", "resvg_py", "tensorboard"}
OPTIONAL = {  # packages of an extra or of notebooks
    *("IPython", "ale_py", "envpool", "h5py", "minari", "moviepy", "ray", "stable_baselines3", "zstandard"),
}
IMPORTED_LATE = {  # what else is imported in functions; milliseconds after `millrace.learner.rollouts.hub` on one machine
    "cloudpickle": "5 ms, for callables only",
    "importlib.metadata": "the version, and kinds of env copies that others install, for which few ask",
    "millrace.learner.imports_ahead": "only if it was imported before",
    "millrace.extras.datasets.record": "160 ms, after the flags are known to be right",
    "millrace.cli.main": "a signal waits until it is imported",
    "millrace.launch.learner_inference": "it is for --inference learner only",
    "millrace.launch.training": "120 ms, after the flags are known to be right",
    "millrace.playing": "160 ms, after the flags are known to be right",
    "millrace.workers.program": "98 ms, after the flags are known to be right",
}
NAME_OF_A_TYPE = r"_?[A-Z][A-Za-z]*[a-z][A-Za-z]*"
SAME_IN_EVERY_PACKAGE = {"Pulse"}  # a function that is called again and again in a long computation
MOST_PARAMETERS = 8  # of a function; self and cls do not count
MAY_TAKE_MORE = {"millrace/launch/vector.py:make_vec"}  # gymnasium's users expect keyword arguments


@cache
def sources(*folders: str) -> tuple[str, ...]:
    return tuple(sorted(str(path.relative_to(ROOT)) for folder in folders for path in (ROOT / folder).rglob("*.py")))


@cache
def tree(source: str) -> ast.Module:
    return ast.parse((ROOT / source).read_text(), source)


def module(source: str) -> str:
    """The dotted name under which a file is imported."""
    name = source.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    return f"millrace.{name}" if name.partition(".")[0] in PARTS else name


def file_of(name: str) -> str:
    """The path of a module of ours, by its dotted name."""
    path = name.replace(".", "/") + ".py"
    return path.removeprefix("millrace/") if path.startswith(tuple(f"millrace/{part}/" for part in PARTS)) else path


def package(name: str) -> str:
    """The package that a dotted name belongs to: one of `PACKAGES`, or its first part."""
    first, _, rest = name.partition(".")
    second = rest.partition(".")[0]
    return second if first == "millrace" and second in PARTS else first


@cache
def nodes(source: str) -> tuple[ast.AST, ...]:
    """All of a file, for the rules that look everywhere."""
    return tuple(ast.walk(tree(source)))


@cache
def modules_imported(source: str) -> frozenset[str]:
    """Dotted names of all that a file imports, wherever in the file it does so; `from a import b` gives `a.b`."""
    found = set()
    for node in nodes(source):
        match node:
            case ast.Import(names=names):
                found |= {alias.name for alias in names}
            case ast.ImportFrom(module=str(name), level=0, names=names):
                found |= {f"{name}.{alias.name}" for alias in names}
            case ast.ImportFrom():
                raise AssertionError(f"{source}:{node.lineno} imports relatively")
    return frozenset(found)


def imports_in_functions(source: str) -> set[str]:
    """Modules that a file imports in a function."""
    found = set()
    for function in nodes(source):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            for node in ast.walk(function):
                match node:
                    case ast.Import(names=names):
                        found |= {alias.name for alias in names}
                    case ast.ImportFrom(module=str(name), names=names):
                        submodules = {f"{name}.{alias.name}" for alias in names} & {
                            module(file) for file in sources(*PACKAGES)
                        }
                        found |= submodules or ({"importlib.metadata"} if name == "importlib" else {name})
    return found


@cache
def is_slow(name: str) -> bool:
    """Whether a module is slow to import or optional, or imports one that is."""
    source = file_of(name)
    if not (ROOT / source).exists():
        return name.partition(".")[0] in SLOW_TO_IMPORT | OPTIONAL
    at_the_top = [node for node in tree(source).body if isinstance(node, ast.Import | ast.ImportFrom)]
    named = {node.module or "" if isinstance(node, ast.ImportFrom) else node.names[0].name for node in at_the_top}
    return any(map(is_slow, named))


def imported(source: str) -> set[str]:
    """The packages of all that a file imports."""
    return {package(name) for name in modules_imported(source)}


def files_imported(source: str, files: Mapping[str, str]) -> set[str]:
    """The files that a file imports, of these (dotted name -> path)."""
    found = set()
    for imported_name in modules_imported(source):
        name = imported_name
        while name and name not in files:
            name = name.rpartition(".")[0]
        if name:
            found.add(files[name])
    return found - {source}


def calls(source: str, name: str) -> list[str]:
    """Where a function of this name is called, by itself or as an attribute of something."""
    found = []
    for node in nodes(source):
        match node:
            case ast.Call(func=ast.Name(id=called)) if called == name:
                found.append(f"{source}:{node.lineno}")
            case ast.Call(func=ast.Attribute(attr=called, value=ast.Name(id=owner))) if called == name:
                found.append(f"{source}:{node.lineno} of {owner}")
    return found


def circles(arrows: Mapping[str, set[str]]) -> list[list[str]]:
    """Groups of files that import each other, directly or through others (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for target in arrows[node]:
            if target not in index:
                visit(target)
                low[node] = min(low[node], low[target])
            elif target in stack:
                low[node] = min(low[node], index[target])
        if low[node] == index[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1:
                found.append(sorted(group))

    for node in list(arrows):
        if node not in index:
            visit(node)
    return found


@pytest.mark.parametrize("folder", PACKAGES)
def test_imports_between_packages_go_one_way(folder: str) -> None:
    assert sources(folder)
    may_all = (COMMAND_LINES,) if folder in ("learner", "workers") else ()
    for source in sources(folder):
        names = {name for name in modules_imported(source) if not name.startswith(may_all)}
        assert not {package(name) for name in names} & FORBIDDEN[folder], source


def test_what_command_lines_are_made_with_imports_only_protocol() -> None:
    assert sources("millrace/flags")
    for source in sources("millrace/flags"):
        assert not imported(source) & {"learner", "workers"}, source


@pytest.mark.parametrize("part", PARTS)
def test_a_part_of_millrace_cannot_be_imported_under_its_bare_name(part: str) -> None:
    """The folder of the repository is on the path: each class would exist twice."""
    with pytest.raises(ImportError, match=f"import millrace.{part} instead of {part}"):
        import_module(part)
    assert (ROOT / "millrace" / part).resolve() == ROOT / part


def test_the_search_for_circles_finds_one() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
    assert not circles({"a": {"b", "c"}, "b": {"c"}, "c": set()})


def test_no_files_import_each_other_in_a_circle() -> None:
    files = {module(source): source for source in sources(*PACKAGES)}
    assert not circles({source: files_imported(source, files) for source in files.values()})


@pytest.mark.parametrize(("folder", "place"), [(folder, place) for folder, rooms in ROOMS.items() for place in rooms])
def test_a_room_imports_only_what_it_may(folder: str, place: str) -> None:
    allowed = ROOMS[folder][place] | {place}
    above = f"{module(f'{folder}/__init__.py')}."
    files = sources(f"{folder}/{place}") or (f"{folder}/{place}.py",)
    for source in files:
        imported_names = {name for name in modules_imported(source) if name.startswith(above) and package(name) == folder}
        places = {name.removeprefix(above).partition(".")[0] for name in imported_names}
        assert places <= allowed, source


@pytest.mark.parametrize("folder", ROOMS)
def test_no_room_is_without_a_rule(folder: str) -> None:
    """But the extras, whose rule is in `test_border.py`."""
    packages = {path.parent.name for path in (ROOT / folder).glob("*/__init__.py")} - {*PARTS}
    assert packages <= {*ROOMS[folder], "extras"}


def test_what_a_file_needs_is_imported_at_its_top_unless_it_is_slow_or_optional() -> None:
    late = {name for source in sources(*PACKAGES) for name in imports_in_functions(source)}
    assert {name for name in late if not is_slow(name)} == IMPORTED_LATE.keys()


def test_the_checks_of_a_client_are_pure() -> None:
    """One file connects them to a socket, a process and the clock; only the command imports that file."""
    for source in sources(CONFORMANCE):
        if source not in (CHECKS_A_CLIENT, CONFORMANCE + "command.py"):
            assert not imported(source) & {"learner", "zmq", "socket", "subprocess", "threading", "time"}, source
            assert CHECKS_A_CLIENT not in files_imported(source, {module(CHECKS_A_CLIENT): CHECKS_A_CLIENT}), source


def test_torch_stays_with_the_learner() -> None:
    for source in sources(*PACKAGES):
        if not source.startswith(("learner/", TORCH_IN_PROTOCOL, TORCH_IN_EXTRAS)):
            assert "torch" not in imported(source), source


def test_torch_s_internals_are_used_in_one_room() -> None:
    for source in sources(*PACKAGES):
        if not source.startswith(TORCH_INTERNALS):
            assert not list(torch_internals(source)), source


def torch_internals(source: str) -> Iterator[str]:
    """Private names of torch that a file uses: `torch._x`, `torch.y._z`, or an import of such a name."""
    for name in modules_imported(source):
        first, *rest = name.split(".")
        if first == "torch" and any(part.startswith("_") for part in rest):
            yield name
    for node in nodes(source):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
            chain = ast.unparse(node)
            if chain.startswith("torch."):
                yield f"{source}:{node.lineno} {chain}"


def test_nothing_is_pickled_but_in_the_one_guarded_place() -> None:
    for source in sources(*PACKAGES):
        if source not in MAY_UNPICKLE:
            assert not imported(source) & {"pickle", "cloudpickle", "dill", "shelve", "marshal", "joblib"}, source
        for node in nodes(source):
            match node:
                case ast.Call(func=ast.Attribute(attr="load", value=ast.Name(id="torch"))):
                    flags = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                    assert flags.get("weights_only") == "True", f"{source}:{node.lineno}"
                case ast.keyword(arg="allow_pickle"):
                    assert ast.unparse(node.value) == "False", f"{source}:{node.lineno}"


def test_the_learner_runs_no_code_of_the_environment() -> None:
    """Workers describe it (`Describe`), evaluate and record: the learner's machine need not have it."""
    for source in sources("learner"):
        assert not [where for name in ENVIRONMENT_CODE for where in every_call(source, name)], source


def every_call(source: str, name: str) -> Iterator[str]:
    """Where a function of this name is called, by itself or as an attribute of anything."""
    for node in nodes(source):
        match node:
            case ast.Call(func=ast.Name(id=called) | ast.Attribute(attr=called)) if called == name:
                yield f"{source}:{node.lineno} {name}"


def test_only_the_command_line_prints() -> None:
    for source in sources(*PACKAGES):
        if not source.startswith(MAY_PRINT) and not source.endswith(COMMAND_OF_EXTRA):
            assert not [where for where in calls(source, "print") if " of " not in where]


def test_command_lines_are_made_in_one_way() -> None:
    """By `millrace.flags`, of a record."""
    for source in sources(*PACKAGES):
        assert not imported(source) & {"argparse", "click", "getopt", "optparse", "tyro"}, source


def test_tests_do_not_sleep() -> None:
    for source in sources("tests"):
        if not source.startswith(MAY_SLEEP) and "sleep" in (ROOT / source).read_text():
            assert not calls(source, "sleep")


def test_a_name_of_a_class_or_a_type_stands_for_one_thing() -> None:
    places: defaultdict[str, list[str]] = defaultdict(list)
    for source in sources(*PACKAGES):
        for node in tree(source).body:
            match node:
                case ast.Assign(value=ast.Call(func=ast.Name(id="TypeVar"))):
                    pass  # it stands for something else in each function
                case ast.ClassDef(name=name) | ast.Assign(targets=[ast.Name(id=name)]) if re.fullmatch(NAME_OF_A_TYPE, name):
                    places[name.lstrip("_")].append(source)
    assert {name for name, where in places.items() if len(where) > 1} == SAME_IN_EVERY_PACKAGE


def test_no_folder_is_a_drawer_for_everything() -> None:
    for source in sources(*PACKAGES, "tests"):
        assert not set(Path(source).parts) & {"utils", "common", "misc", "helpers"}, source


def test_one_file_derives_all_random_numbers() -> None:
    """A stream that is made elsewhere may be another one's, or the environment's."""
    for source in sources(*PACKAGES):
        if source == RANDOM_STREAMS or source.startswith(HAS_RANDOM_NUMBERS_OF_ITS_OWN):
            continue
        for node in nodes(source):
            match node:
                case ast.Attribute(attr="default_rng" | "SeedSequence") | ast.Name(id="default_rng" | "SeedSequence"):
                    raise AssertionError(f"{source}:{node.lineno} makes random numbers")
                case ast.Call(func=ast.Attribute(attr="manual_seed"), args=args):
                    assert [ast.unparse(each).partition("(")[0] for each in args] == ["torch_seed"], (
                        f"{source}:{node.lineno}"
                    )


def test_no_function_takes_too_many_parameters() -> None:
    """A narrow record takes their place."""
    for source in sources(*PACKAGES):
        for node in nodes(source):
            if isinstance(node, ast.FunctionDef) and f"{source}:{node.name}" not in MAY_TAKE_MORE:
                every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                names = [argument.arg for argument in every if argument.arg not in ("self", "cls")]
                assert len(names) <= MOST_PARAMETERS, f"{source}:{node.lineno} {node.name}({', '.join(names)})"


def test_the_learner_s_socket_is_opened_in_one_place() -> None:
    """So that its keys, its context and the order in which they are closed are the same in every launcher."""
    found = {where.partition(":")[0] for source in sources(*PACKAGES) for where in every_call(source, "LearnerLink")}
    assert found == {"learner/members/bound.py"}


def test_every_file_says_first_what_it_holds() -> None:
    for source in sources(*PACKAGES, "tests"):
        assert re.match(r'r?"""\S|$', (ROOT / source).read_text().strip()), source


def test_every_public_name_of_millrace_is_documented() -> None:
    import millrace

    for name in millrace.__all__:
        assert name == "__version__" or (getattr(millrace, name).__doc__ or "").strip(), name


@pytest.mark.parametrize(
    ("names", "heavy"),
    [
        ("millrace.door", SLOW_TO_IMPORT),
        ("millrace.workers.__main__", {"numpy", "gymnasium", "torch"}),
        (
            "millrace.learner.algorithms, millrace.learner.config.command_line, millrace.learner.policy_player",
            SLOW_TO_IMPORT,
        ),
        ("millrace.extras.monitoring.report.picture, millrace.cli.main", SLOW_TO_IMPORT),
    ],
)
def test_what_must_start_quickly_imports_nothing_that_is_slow_to_import(names: str, heavy: set[str]) -> None:
    asks = f"import sys, {names}; assert not sys.modules.keys() & {heavy}"
    done = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
