"""Print how many lines the program has, by package and kind, and how many words the documentation has.

Code is what is left of a Python file without blank lines, docstrings, imports and comments. A string below an
assignment describes it, and counts as a docstring.
"""

import ast
import io
import subprocess
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
KINDS = ("code", "docstring", "import", "comment", "blank")


def count_lines(source: str) -> Counter[str]:
    """Return the number of lines of each kind in a Python file, and `files`, which is 1."""
    kinds = {}
    for number, line in enumerate(source.splitlines(), start=1):
        kinds[number] = "code" if line.strip() else "blank"
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and token.line.strip().startswith("#"):
            kinds[token.start[0]] = "comment"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            kind = "import"
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            kind = "docstring"
        else:
            continue
        kinds.update(dict.fromkeys(range(node.lineno, (node.end_lineno or node.lineno) + 1), kind))
    return Counter(kinds.values()) + Counter(files=1)


def list_files(folder: str, suffix: str) -> list[Path]:
    """Return the files of a folder that git knows."""
    listed = subprocess.run(["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in listed.splitlines() if name.endswith(suffix) and (ROOT / name).is_file()]


def build_table() -> list[tuple[str, Counter[str]]]:
    """Return the lines of each package of the program, of all of it, of the tests and of the scripts."""
    rows: dict[str, Counter[str]] = {}
    for folder in ("optodrive", "tests", "scripts"):
        total: Counter[str] = Counter()
        for path in list_files(folder, ".py"):
            lines = count_lines(path.read_text())
            total.update(lines)
            parts = path.relative_to(ROOT).parts
            if folder == "optodrive" and len(parts) > 2:
                rows.setdefault("/".join(parts[:-1][:3]), Counter()).update(lines)
        rows[folder] = total
    return list(rows.items())


def main() -> int:
    """Print the table."""
    print(f"{'':<34}" + "".join(f"{kind:>11}" for kind in ("files", *KINDS)))
    for name, lines in build_table():
        print(f"{name:<34}" + "".join(f"{lines[kind]:>11,}" for kind in ("files", *KINDS)))
    pages = list_files("docs", ".md")
    parts = [part for page in pages for part in page.read_text().split()]
    words = sum(any(map(str.isalnum, part)) for part in parts)
    print(f"docs: {words:,} words in {len(pages)} pages, {len(parts):,} with bars and rules of tables and other signs")
    return 0


if __name__ == "__main__":
    sys.exit(main())
