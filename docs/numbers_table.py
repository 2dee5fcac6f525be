"""Writes the tables of ``numbers.md`` from the code: ``make docs``.

The page names files and numbers; their values and what they mean are taken from there.
"""

import ast
import io
import json
import re
import tokenize
from pathlib import Path

from triquad_server.settings.settings import setting_schemas

PAGE = Path(__file__).with_name("numbers.md")
ROOT = PAGE.parent.parent


def with_tables(page: str) -> str:
    """The page, with the value and the meaning of each number in its rows."""
    return re.sub(r"^\| `(\S+)` (\S+) \|.*\n", _row, page, flags=re.MULTILINE)


def _row(found: re.Match[str]) -> str:
    name, path = found[1], found[2]
    value, meaning = _setting(name) if path == "settings" else _number(ROOT / path, name)
    return f"| `{name}` {path} | {value} | {meaning} |\n"


def _setting(key: str) -> tuple[str, str]:
    """Return the default of a setting, and its description."""
    section, _, name = key.partition(".")
    schema = setting_schemas()[section][name]
    return json.dumps(schema["default"]), " ".join(schema["description"].split())


def _number(path: Path, name: str) -> tuple[str, str]:
    """Return the value of a constant or of a record's field, and what is written about it."""
    source = path.read_text(encoding="utf-8")
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    for parent in ast.walk(ast.parse(source)):
        body = getattr(parent, "body", None)
        for at, statement in enumerate(body if isinstance(body, list) else ()):
            values = _values(statement)
            if name in values:
                meaning = comments.get(statement.end_lineno) or _docstring(body[at + 1 :])
                if meaning is None:
                    raise ValueError(f"{path}: nothing is written about {name}")
                value = re.sub(r"np\.\w+\((.*)\)", r"\1", ast.unparse(values[name]))
                return value, meaning.replace("|", "\\|")
    raise ValueError(f"{path} has no {name}: correct {PAGE}")


def _values(statement: ast.stmt) -> dict[str, ast.expr]:
    """Return what a statement assigns to names."""
    if isinstance(statement, ast.AnnAssign) and statement.value is not None:
        targets, value = [statement.target], statement.value
    elif isinstance(statement, ast.Assign):
        targets, value = statement.targets, statement.value
    else:
        return {}
    (target,) = targets
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        return {ast.unparse(name): one for name, one in zip(target.elts, value.elts, strict=True)}
    return {ast.unparse(target): value}


def _docstring(after: list[ast.stmt]) -> str | None:
    """Return the docstring that follows some assignments, in one line."""
    for statement in after:
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            return " ".join(str(statement.value.value).split())
        if not _values(statement):
            break
    return None


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
