"""`rol` stays small: code, files, parameters and settings have limits, which hold for later additions too."""

import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "rol"
FILES = sorted(PACKAGE.rglob("[!.]*.py"))
MAX_LINES, MAX_FILE_LINES, MAX_PARAMETERS, MAX_FIELDS = 2600, 400, 7, 12
LAYOUT = {getattr(tokenize, name) for name in ["COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER"]}


def count_code_lines(source: str) -> int:
    """Count the lines that hold code, without docstrings, comments and blank lines."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in LAYOUT:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        is_scope = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if is_scope and ast.get_docstring(node, clean=False) is not None:
            lines -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return len(lines)


def public_functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """List public functions and the public methods and constructors of public classes."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name, node
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            for part in node.body:
                if isinstance(part, ast.FunctionDef) and (part.name == "__init__" or part.name[0] != "_"):
                    yield f"{node.name}.{part.name}", part


def count_parameters(function: ast.FunctionDef) -> int:
    """Count parameters, without `self` and `cls`."""
    arguments = function.args
    names = [a.arg for a in arguments.posonlyargs + arguments.args + arguments.kwonlyargs]
    variable = [a for a in (arguments.vararg, arguments.kwarg) if a]
    return len([name for name in names if name not in ("self", "cls")]) + len(variable)


def test_counting_leaves_out_docstrings_comments_and_blank_lines() -> None:
    source = '"""Doc.\n\nMore."""\n\nX = """\na"""  # comment\n\n\ndef f(a, *, b=1):\n    """Doc."""\n    return a\n'
    assert count_code_lines(source) == 4
    [(name, function)] = public_functions(ast.parse(source))
    assert (name, count_parameters(function)) == ("f", 2)


def test_package_and_its_files_are_short() -> None:
    lengths = {file.name: count_code_lines(file.read_text(encoding="utf-8")) for file in FILES}
    assert {name: n for name, n in lengths.items() if n > MAX_FILE_LINES} == {}
    assert sum(lengths.values()) <= MAX_LINES, lengths


def test_functions_have_few_parameters() -> None:
    counts = {
        f"{file.name}: {name}": count_parameters(function)
        for file in FILES
        for name, function in public_functions(ast.parse(file.read_text(encoding="utf-8")))
    }
    assert {name: n for name, n in counts.items() if n > MAX_PARAMETERS} == {}


def test_classes_have_few_fields() -> None:
    counts = {
        f"{file.name}: {node.name}": sum(isinstance(part, ast.AnnAssign) for part in node.body)
        for file in FILES
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    }
    assert {name: n for name, n in counts.items() if n > MAX_FIELDS} == {}
