# Tests of tests/test_functions.py
"""The length of functions, and the number of their parameters."""

from __future__ import annotations

import ast
import io
import itertools
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import nermo_mjx

PACKAGE: Final = Path(nermo_mjx.__file__).parent
#: Lines of code of a function, without docstrings, comments and blank lines, and its parameters without self and cls.
MOST_LINES: Final = 60
MOST_PARAMETERS: Final = 8
#: A function beyond a limit has one of these comments in the lines above its `def`.
LONG: Final = "# Long because "
WIDE: Final = "# Many parameters because "
LAYOUT: Final = {
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.COMMENT,
    tokenize.ENDMARKER,
}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def comments_above(lines: list[str], number: int) -> list[str]:
    """The comments in the lines above a line with this number."""
    above = (line.strip() for line in reversed(lines[: number - 1]))
    return list(itertools.takewhile(lambda line: line.startswith("#"), above))


def functions(text: str) -> Iterator[tuple[Function, int, int, list[str]]]:
    """Functions of a module, their lines of code, numbers of parameters, and the comments above their `def`."""
    tree, code, lines = ast.parse(text), set[int](), text.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in LAYOUT:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if isinstance(node, Function | ast.ClassDef) and ast.get_docstring(node) is not None:
            code.difference_update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    for node in ast.walk(tree):
        if isinstance(node, Function):
            given = node.args
            named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
            parameters = [each.arg for each in (*named, given.vararg, given.kwarg) if each]
            count = len({*parameters} - {"self", "cls"})
            length = len(code.intersection(range(node.lineno, (node.end_lineno or 0) + 1)))
            yield node, length, count, comments_above(lines, node.lineno)


def test_functions_are_short_and_have_few_parameters_or_a_comment_states_the_reason() -> None:
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        if "vendor" in path.parts:
            continue
        for node, length, count, comments in functions(path.read_text()):
            place = f"{path.relative_to(PACKAGE)}:{node.lineno} {node.name}"
            if (length > MOST_LINES) != any(line.startswith(LONG) for line in comments):
                wrong.append(f"{place} has {length} lines of code; its comments: {comments}")
            if (count > MOST_PARAMETERS) != any(line.startswith(WIDE) for line in comments):
                wrong.append(f"{place} has {count} parameters; its comments: {comments}")
    assert wrong == []


def test_lines_of_code_and_parameters_are_counted() -> None:
    text = '''
class Example:
    # Long because it is an example.
    def example(self, a, /, b, *c, d=1, **e):
        """A docstring

        of three lines."""
        # a comment
        x = """a text
        of two lines"""

        def inner():
            """Another docstring."""
            return x

        return inner
'''
    (example, length, count, comments), (_, inner, none, _) = functions(text)
    assert (example.name, length, count, inner, none) == ("example", 6, 5, 2, 0)
    assert comments == ["# Long because it is an example."]
