"""Draw files and sentences at random, to test how well a stranger understands them.

A person who has never seen the project says from each path alone what the file holds, and restates
each sentence. A second person grades both with the files open. The commit's hash is the seed, so
nobody chooses the sample.
"""

from __future__ import annotations

import argparse
import ast
import random
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
_PAGES = (".md",)
_SHORTEST = 6  # words; fewer are captions and labels


def main() -> None:
    """Print the sample: paths first, then sentences without the place they come from."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=10, help="number of files (default: 10)")
    parser.add_argument(
        "--sentences", type=int, default=20, help="number of sentences (default: 20)"
    )
    parser.add_argument(
        "--seed", default=_git("rev-parse", "HEAD").strip(), help="default: the commit's hash"
    )
    parser.add_argument(
        "--places", action="store_true", help="print where each sentence stands, for the grader"
    )
    options = parser.parse_args()
    tracked = [Path(line) for line in _git("ls-files").splitlines()]
    modules = [path for path in tracked if path.suffix == ".py" and path.name != "__init__.py"]
    pages = [path for path in tracked if path.suffix in _PAGES and "tests" not in path.parts]
    product = [path for path in modules if path.parts[0] not in ("tests", "benchmarks")]
    sentences = sorted(
        {(text, str(path)) for path in pages for text in prose(path)}
        | {(text, str(path)) for path in product for text in messages(path)}
    )
    draw = random.Random(options.seed)
    print(f"seed {options.seed}: {len(modules)} files, {len(sentences)} sentences")
    for number, path in enumerate(draw.sample(modules, options.files), 1):
        print(f"{number}. {path}")
    for number, (text, path) in enumerate(draw.sample(sentences, options.sentences), 1):
        print(f"{number}. {text}" + (f"  [{path}]" if options.places else ""))


def prose(path: Path) -> Iterator[str]:
    """Yield the sentences of a page, without code blocks, tables and headings."""
    text = re.sub(r"```.*?```|^ {4}.*?$", "", (ROOT / path).read_text(), flags=re.DOTALL | re.M)
    for paragraph in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.)\s)", text):
        if not paragraph.lstrip().startswith(("#", "|", "<", "!")):
            yield from _sentences(re.sub(r"^\s*(?:[-*]|\d+\.)\s", "", paragraph))


def messages(path: Path) -> Iterator[str]:
    """Yield the texts that a module shows its users: of errors that it raises and of `help=`."""
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        shown: list[ast.expr] = []
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            shown = node.exc.args[:1]
        elif isinstance(node, ast.keyword) and node.arg in ("help", "description"):
            shown = [node.value]
        for text in shown:
            yield from _sentences(_literal(text))


def _literal(node: ast.expr) -> str:
    """Return the text of a literal; values that it inserts stand as {name}."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        parts = (
            p.value if isinstance(p, ast.Constant) else f"{{{ast.unparse(p.value)}}}"
            for p in node.values
        )
        return "".join(map(str, parts))
    return ""


def _sentences(text: str) -> Iterator[str]:
    for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z`*])", " ".join(text.split())):
        if len(sentence.split()) >= _SHORTEST:
            yield sentence


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


if __name__ == "__main__":
    main()
