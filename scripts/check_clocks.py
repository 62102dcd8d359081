"""Find comparisons in tests that depend on the speed of the computer.

A test states order, cause, work or the board's own time; scripts/bench measures the computer. So three kinds of values
that stem from a clock of the host are followed through the syntax trees of all tests:

- an instant: the reading of a clock. A comparison of instants states an order and is allowed;
- a shifted instant: a deadline, such as an instant plus 5 s;
- a duration: the difference of an instant and another time.

A comparison with a duration or a shifted instant is refused, as a lower bound too. It may only be the condition of a
`while` that keeps an activity going and is not followed by a verdict.

Values are followed through names, containers, attributes and keys with a unit of time in their name, and the results of
functions of the same module and of those that it imports from, found by name alone. Parameters are not followed.
"""

import ast
import re
import sys
from collections.abc import Iterator
from enum import IntEnum
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CLOCKS = {"monotonic", "perf_counter", "process_time", "thread_time", "time"}
CLOCKS |= {f"{name}_ns" for name in CLOCKS}
READING = re.compile(rf"\b(?:{'|'.join(CLOCKS)})\(")
CLOCK_OWNERS = {"time", "loop"}
LOOPS = {"get_running_loop", "get_event_loop"}
TRANSPARENT = {
    *("abs", "approx", "array", "concatenate", "diff", "float", "int", "list", "max", "mean", "median", "min", "next"),
    *("percentile", "ptp", "quantile", "round", "sorted", "sum", "tuple", "values", "vstack", "popleft", "pop", "copy"),
}
"""Functions and methods whose result is of the same kind as what they receive."""
COMPARING = {"isclose", "allclose", "assert_allclose", "assert_array_less"}
TIME_UNITS = ("_s", "_ms", "_us", "_ns")


class Kind(IntEnum):
    """Kind of a value. Of several, the largest prevails."""

    OTHER = 0
    INSTANT = 1
    SHIFTED = 2
    DURATION = 3


class Facts:
    """Kinds of the attributes, string keys and results of functions of one module, by name.

    others: facts of the modules that it imports from
    """

    def __init__(self) -> None:
        self.attributes: dict[str, Kind] = {}
        self.results: dict[str, Kind] = {}
        self.others: list[Facts] = []

    def count(self) -> int:
        """Return a number that grows with every fact."""
        return sum(self.attributes.values()) + sum(self.results.values())

    def find_attribute(self, name: str) -> Kind:
        """Return the kind of an attribute or key. Only a name that ends in a unit of time has one."""
        if not name.endswith(TIME_UNITS):
            return Kind.OTHER
        return max(facts.attributes.get(name, Kind.OTHER) for facts in (self, *self.others))

    def find_result(self, name: str) -> Kind:
        return max(facts.results.get(name, Kind.OTHER) for facts in (self, *self.others))


def raise_kind(table: dict[str, Kind], name: str, kind: Kind) -> None:
    if kind > table.get(name, Kind.OTHER):
        table[name] = kind


def get_called_name(call: ast.Call) -> str:
    function = call.func
    return (
        function.attr if isinstance(function, ast.Attribute) else function.id if isinstance(function, ast.Name) else ""
    )


def is_clock(call: ast.Call, imported: set[str]) -> bool:
    """Return whether a call reads a clock of the host."""
    function = call.func
    if isinstance(function, ast.Name):
        return function.id in imported
    if not isinstance(function, ast.Attribute) or function.attr not in CLOCKS:
        return False
    owner = function.value
    if isinstance(owner, ast.Call):
        return get_called_name(owner) in LOOPS
    return getattr(owner, "id", getattr(owner, "attr", "")) in CLOCK_OWNERS


class Scope:
    """Kinds of the names of one function or module. parent: the scope around it, None for a module."""

    def __init__(self, facts: Facts, parent: "Scope | None", imported: set[str]) -> None:
        self.facts, self.parent, self.imported = facts, parent, imported
        self.names: dict[str, Kind] = {}

    def get_name(self, name: str) -> Kind:
        found = self.names.get(name)
        if found is None and self.parent is not None:
            return self.parent.get_name(name)
        return found or Kind.OTHER

    def find_kind(self, node: ast.AST | None) -> Kind:
        """Return the kind of an expression."""
        match node:
            case ast.Name(id=name):
                return self.get_name(name)
            case ast.Attribute(attr=name) | ast.Subscript(slice=ast.Constant(value=str(name))):
                return self.facts.find_attribute(name)
            case ast.Call():
                return self._find_call(node)
            case ast.BinOp(left=left, op=operator, right=right):
                return self._combine(self.find_kind(left), operator, self.find_kind(right), left, right)
            case ast.UnaryOp(operand=inner) | ast.Subscript(value=inner) | ast.Starred(value=inner):
                return self.find_kind(inner)
            case ast.NamedExpr(value=inner) | ast.Await(value=inner):
                return self.find_kind(inner)
            case ast.IfExp(body=body, orelse=other):
                return max(self.find_kind(body), self.find_kind(other))
            case ast.BoolOp(values=values) | ast.Tuple(elts=values) | ast.List(elts=values) | ast.Set(elts=values):
                return max(map(self.find_kind, values), default=Kind.OTHER)
            case ast.ListComp(elt=item) | ast.GeneratorExp(elt=item) | ast.SetComp(elt=item) | ast.DictComp(value=item):
                return self.find_kind(item)
        return Kind.OTHER

    def _find_call(self, call: ast.Call) -> Kind:
        if is_clock(call, self.imported):
            return Kind.INSTANT
        name = get_called_name(call)
        if name in TRANSPARENT:
            receiver = [call.func.value] if isinstance(call.func, ast.Attribute) else []
            return max(map(self.find_kind, [*receiver, *call.args]), default=Kind.OTHER)
        return self.facts.find_result(name)

    @staticmethod
    def _combine(left: Kind, operator: ast.operator, right: Kind, *nodes: ast.AST) -> Kind:
        if max(left, right) in (Kind.OTHER, Kind.DURATION):
            return max(left, right)
        if isinstance(operator, ast.Sub):
            is_shift = isinstance(nodes[1], ast.Constant) or getattr(nodes[1], "id", "").isupper()
            return Kind.SHIFTED if is_shift else Kind.DURATION
        return Kind.SHIFTED if isinstance(operator, ast.Add) else max(left, right)

    def assign(self, target: ast.AST, kind: Kind, value: ast.AST | None = None) -> None:
        """Give a target the kind of its value, part by part where both are tuples."""
        match target:
            case ast.Name(id=name):
                raise_kind(self.names, name, kind)
            case ast.Attribute(attr=name) | ast.Subscript(slice=ast.Constant(value=str(name))):
                raise_kind(self.facts.attributes, name, kind)
            case ast.Subscript(value=inner):
                self.assign(inner, kind)
            case ast.Tuple(elts=parts) | ast.List(elts=parts):
                if isinstance(value, ast.Tuple) and len(value.elts) == len(parts):
                    for part, one in zip(parts, value.elts, strict=True):
                        self.assign(part, self.find_kind(one), one)
                elif isinstance(value, ast.Tuple | ast.List | None):
                    for part in parts:
                        self.assign(part, kind)
                elif parts:  # of a function's several results, those whose names end in a unit of time
                    for part in parts:
                        name = getattr(part, "id", getattr(part, "attr", ""))
                        if name.endswith(TIME_UNITS):
                            self.assign(part, kind)


class Reader(ast.NodeVisitor):
    """Follows the values of one file.

    problems: lines of refused comparisons
    """

    def __init__(self, facts: Facts, tree: ast.Module) -> None:
        imported = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module == "time"
            for alias in node.names
            if alias.name in CLOCKS
        }
        self.facts = facts
        self.scope = Scope(facts, None, imported)
        self.function = ""
        self.problems: set[int] = set()
        self.activities = {id(test) for loop in find_activities(tree) for test in ast.walk(loop.test)}
        self.visit(tree)

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        around, self.scope = self.scope, Scope(self.facts, self.scope, self.scope.imported)
        name, self.function = self.function, node.name
        for _ in range(2):  # a loop may use what it assigns later
            self.generic_visit(node)
        self.scope, self.function = around, name

    visit_AsyncFunctionDef = visit_FunctionDef  # noqa: N815 # the name that ast gives it

    def visit_Assign(self, node: ast.Assign) -> None:
        self.generic_visit(node)
        for target in node.targets:
            self.scope.assign(target, self.scope.find_kind(node.value), node.value)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.generic_visit(node)
        self.scope.assign(node.target, self.scope.find_kind(node.value))

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.generic_visit(node)
        combined = ast.BinOp(node.target, node.op, node.value)
        self.scope.assign(node.target, self.scope.find_kind(combined))

    def visit_NamedExpr(self, node: ast.NamedExpr) -> None:
        self.generic_visit(node)
        self.scope.assign(node.target, self.scope.find_kind(node.value))

    def visit_For(self, node: ast.For | ast.comprehension) -> None:
        self.scope.assign(node.target, self.scope.find_kind(node.iter), node.iter)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        self.visit_For(node)

    def visit_ListComp(self, node: ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp) -> None:
        for generator in node.generators:
            self.visit(generator)
        self.generic_visit(node)

    visit_SetComp = visit_DictComp = visit_GeneratorExp = visit_ListComp  # noqa: N815 # the names that ast gives them

    def visit_Return(self, node: ast.Return) -> None:
        self.generic_visit(node)
        raise_kind(self.facts.results, self.function, self.scope.find_kind(node.value))

    def visit_Yield(self, node: ast.Yield) -> None:
        self.generic_visit(node)
        raise_kind(self.facts.results, self.function, self.scope.find_kind(node.value))

    def visit_Dict(self, node: ast.Dict) -> None:
        self.generic_visit(node)
        for key, value in zip(node.keys, node.values, strict=True):
            if isinstance(key, ast.Constant) and isinstance(key.value, str):
                raise_kind(self.facts.attributes, key.value, self.scope.find_kind(value))

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        for keyword in node.keywords:
            if keyword.arg:
                raise_kind(self.facts.attributes, keyword.arg, self.scope.find_kind(keyword.value))
        if isinstance(node.func, ast.Attribute) and node.func.attr in ("append", "add", "extend", "setdefault"):
            kind = max(map(self.scope.find_kind, node.args), default=Kind.OTHER)
            self.scope.assign(node.func.value, kind)
        if get_called_name(node) in COMPARING and any(self.scope.find_kind(one) > Kind.INSTANT for one in node.args):
            self.problems.add(node.lineno)

    def visit_Compare(self, node: ast.Compare) -> None:
        self.generic_visit(node)
        if id(node) in self.activities or isinstance(node.ops[0], ast.Is | ast.IsNot | ast.In | ast.NotIn):
            return
        if max(map(self.scope.find_kind, [node.left, *node.comparators])) > Kind.INSTANT:
            self.problems.add(node.lineno)


def find_activities(tree: ast.Module) -> Iterator[ast.While]:
    """Yield the `while` loops that no verdict follows."""
    for node in ast.walk(tree):
        for body in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
            if not isinstance(body, list):
                continue
            for statement, following in zip_longest(body, body[1:]):
                if isinstance(statement, ast.While) and not statement.orelse and not is_verdict(following):
                    yield statement


def is_verdict(statement: ast.stmt | None) -> bool:
    """Return whether a statement fails the test or may fail it."""
    call = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(statement, ast.Raise | ast.Assert) or (
        isinstance(call, ast.Call) and get_called_name(call) == "fail"
    )


def find_problems(sources: dict[str, str]) -> list[str]:
    """Return one line per refused comparison.

    sources: texts by path
    """
    trees = {path: ast.parse(text) for path, text in sources.items()}
    modules = {path: Facts() for path in trees}
    for path, tree in trees.items():
        names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
        modules[path].others = [facts for other, facts in modules.items() if Path(other).stem in names]
    readers, to_read = {}, [path for path, text in sources.items() if READING.search(text)]
    while to_read:
        before = {path: facts.count() for path, facts in modules.items()}
        readers |= {path: Reader(modules[path], trees[path]) for path in to_read}
        changed = [modules[path] for path in to_read if modules[path].count() != before[path]]
        to_read = [path for path, facts in modules.items() if any(one in changed for one in (facts, *facts.others))]
    return [
        f"{path}:{line}: {sources[path].splitlines()[line - 1].strip()!r} judges the computer: "
        "state the cause, or measure it in scripts/bench gate"
        for path, reader in sorted(readers.items())
        for line in sorted(reader.problems)
    ]


def main() -> int:
    paths = sorted((ROOT / "tests").rglob("*.py"))
    problems = find_problems({str(path.relative_to(ROOT)): path.read_text() for path in paths})
    print("\n".join(problems) or f"{len(paths)} files of tests compare no time of the computer")
    return bool(problems)


if __name__ == "__main__":
    sys.exit(main())
