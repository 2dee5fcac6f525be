"""What a Dockerfile says, as far as it can be followed without a container."""

import json
import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Stage:
    """One stage of a build: its steps in order, with the build arguments put in."""

    base: str
    arguments: dict[str, str] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    steps: list[tuple[str, str]] = field(default_factory=list)

    def all(self, instruction: str) -> list[str]:
        return [text for name, text in self.steps if name == instruction]

    def one(self, instruction: str) -> str:
        (text,) = self.all(instruction)
        return text

    def command(self, instruction: str) -> list[str]:
        """The words of an instruction in the form of a list."""
        words: list[str] = json.loads(self.one(instruction)[self.one(instruction).index("[") :])
        return words


def stages(path: Path) -> list[Stage]:
    """The stages of a Dockerfile, in order."""
    found: list[Stage] = []
    common: dict[str, str] = {}
    text = re.sub(r"^\s*#.*\n", "", path.read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    for line in filter(None, map(str.strip, text.split("\n"))):
        instruction, _, rest = line.partition(" ")
        rest = rest.strip()
        if instruction == "FROM":
            found.append(Stage(_with(rest, common), dict(common)))
        elif instruction == "ARG":
            name, _, value = rest.partition("=")
            (found[-1].arguments if found else common).setdefault(name, value)
        elif instruction == "ENV":
            stage = found[-1]
            for word in shlex.split(rest):
                name, _, value = word.partition("=")
                stage.environment[name] = _with(value, stage.arguments)
        else:
            found[-1].steps.append((instruction, rest))
    return found


def _with(text: str, values: dict[str, str]) -> str:
    """A text with the values of ``$NAME`` and ``${NAME}``, where they are known."""

    def value(match: "re.Match[str]") -> str:
        return values.get(match[1] or match[2], match[0])

    return re.sub(r"\$(?:\{(\w+)\}|(\w+))", value, text)
