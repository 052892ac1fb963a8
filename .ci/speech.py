"""Phrases that readers stumble over, in code and documents; exit code 1 if there are any.

Only comments, docstrings, texts and Markdown count; code in Markdown does not. CONTRIBUTING.md
lists what to write instead. Local names in the package and the tests that do not say what a value
is count, too.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

PHRASES = {
    r"\b(is|are|was|were) no (?!longer|more\b|later|earlier|farther|further|other|surface|map\b)"
    r"[a-z]+": "is not a",
    r"\bthat of\b": "name the thing again, or use the possessive",
    r"\bthose of\b": "name the things again, or use the possessive",
    r"\bwhat (is|was|stands|stood)\b": "use a noun",
    r"\b(asks|asked)\b": "query, search, request",
    r"\b(says|said) ": "states, gives; names say what a value is",
    r"\bsuch as are\b": "say which",
    r"\bstreets that look like others\b": "ambiguous places",
}
EMPTY_NAMES = {"found", "at", "near", "said", "mine", "much"}  # of values, in functions
OPTIONS = "cli/commands/"  # parameters there are options of users
PATTERN = re.compile("|".join(f"(?:{phrase})" for phrase in PHRASES))


def texts_of(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are read as prose, with their numbers."""
    content = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        is_code = False
        for number, line in enumerate(content.splitlines(), 1):
            is_code ^= line.startswith("```")
            if not is_code:
                yield number, re.sub(r"`[^`]*`", "", line)
        return
    for token in tokenize.generate_tokens(io.StringIO(content).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING):
            for offset, line in enumerate(token.string.splitlines()):
                yield token.start[0] + offset, line


def empty_names(path: Path) -> Iterator[tuple[int, str]]:
    """Lines of functions that give a value an empty name, and the name."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    nodes = {id(node): node for function in functions for node in ast.walk(function)}
    for node in nodes.values():
        if isinstance(node, ast.arg) and node.arg in EMPTY_NAMES and OPTIONS not in str(path):
            yield node.lineno, node.arg
        if (
            isinstance(node, ast.Name)
            and node.id in EMPTY_NAMES
            and isinstance(node.ctx, ast.Store)
        ):
            yield node.lineno, node.id


def main() -> int:
    """Print every occurrence; their number decides the exit code."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py", "*.md", ":!.ci"],
        capture_output=True,
        text=True,
        check=True,
    )
    count = 0
    for name in listed.stdout.split():
        path = Path(name)
        if not path.exists():
            continue
        for number, line in texts_of(path):
            if match := PATTERN.search(line):
                count += 1
                print(f"{name}:{number}: '{match.group(0).strip()}': {line.strip()[:90]}")
        if name.startswith(("semloc_logs/", "cli/", "tests/")) and path.suffix == ".py":
            for number, word in empty_names(path):
                count += 1
                print(f"{name}:{number}: '{word}' does not say what the value is")
    return int(count > 0)


if __name__ == "__main__":
    sys.exit(main())
