# SPDX-License-Identifier: Apache-2.0
"""Builds the site of these pages: ``make docs``, or ``python docs/build_site.py --out results/docs``.

It copies the pages of ``docs/`` and adds

- ``api/``: a page for each public module, from its docstrings;
- ``messages.md``: from the ``.msg`` files;
- ``readme.md`` and ``contributing.md``: the README and CONTRIBUTING;
- ``parameters.md``: generated from the declarations.

Links to source files become links to the pages of their modules. First `links.py` checks all links and anchors; then
Sphinx builds the site, and any warning is an error. Nothing is downloaded.
"""

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), *(str(path) for path in (ROOT / "src").glob("*/"))]
import links  # noqa: E402

PACKAGES = (
    "flexarm_dynamics",
    "flexarm_control",
    "flexarm_sim",
    "flexarm_studies",
    "flexarm_ros",
    "flexarm_tools",
    "flexarm_bringup",
)
#: Pages outside of docs/.
AT_THE_ROOT = ("README.md", "CONTRIBUTING.md")


def modules(package):
    """Dotted names of the public modules of a package, with their files."""
    top = ROOT / "src" / package / package
    for path in sorted(top.rglob("*.py")):
        parts = path.relative_to(top).with_suffix("").parts
        if parts[-1] == "__init__":
            parts = parts[:-1]
        if not any(part.startswith("_") for part in parts):
            yield ".".join((package, *parts)), path


def first_sentence(path):
    """First line of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.split("\n\n")[0].replace("\n", " ")


def write_api(out):
    """Write a page per module, and one per package that lists them."""
    out.mkdir(parents=True)
    index = ["# API", "", "From the docstrings of the public modules.", ""]
    toc = []
    for package in PACKAGES:
        found = dict(modules(package))
        toc.append(package)
        for name in found:
            inner = [n for n in found if n.rpartition(".")[0] == name]
            text = [name, "=" * len(name), "", f".. automodule:: {name}", ""]
            if inner:
                text += [".. toctree::", "   :maxdepth: 1", "", *(f"   {n}" for n in inner), ""]
            (out / f"{name}.rst").write_text("\n".join(text), encoding="utf-8")
        index.append(f"- [{package}]({package}.rst): {first_sentence(found[package])}")
    index += ["", "```{toctree}", ":hidden:", "", *toc, "```", ""]
    (out / "index.md").write_text("\n".join(index), encoding="utf-8")


def write_messages(file):
    """All messages: what the head of each file says, a table of its fields and constants, the file itself."""
    text = [
        "# Messages",
        "",
        "From the `.msg` files of `flexarm_msgs`; which topic takes which: [ROS](ros.md).",
        "",
    ]
    for path in sorted((ROOT / "src" / "flexarm_msgs" / "msg").glob("*.msg")):
        source = path.read_text(encoding="utf-8")
        head = re.match(r"(?:#.*\n)*", source).group()
        text += [f"## flexarm_msgs/{path.stem}", ""]
        text += [line.lstrip("#").strip() for line in head.splitlines()]
        text += ["", "| type | field | |", "|---|---|---|"]
        for line in source[len(head) :].splitlines():
            match = re.match(r"(\S+)\s+([^\s=]+)(=\S+)?\s*(?:#\s*(.*))?$", line)
            if match:
                kind, name, value, about = match.groups()
                text.append(
                    f"| `{kind}` | `{name}{value or ''}` | {(about or '').replace('|', chr(92) + '|')} |"
                )
        text.append("")
    file.write_text("\n".join(text), encoding="utf-8")


def write_parameters(file):
    """Write the page with the tables of the declarations."""
    from flexarm_tools import parameter_tables

    parameter_tables.write(file)


def adapt(text, page):
    """Rewrite the links of a page: to the site's page of a module where there is one."""
    known = {}
    for package in PACKAGES:
        for name, path in modules(package):
            known[path.parent if path.name == "__init__.py" else path] = name

    def target(match):
        path, hash_, anchor = match.group(1).partition("#")
        if not path or re.match(r"[a-z]+:", path):
            return match.group()
        file = Path(os.path.normpath(page.parent / path))
        up = "../" * len(page.parent.relative_to(HERE).parts)
        if file in known:
            return f"]({up}api/{known[file]}.rst)"
        if file.parent == ROOT and file.name in AT_THE_ROOT:
            return f"]({up}{file.name.lower()}{hash_}{anchor})"
        if HERE in file.parents:
            return match.group()
        return f"]({up}{file.relative_to(ROOT)})"

    return links.LINK.sub(target, text)


def copy_pages(out):
    """Copy docs/, the README and what they link to into a directory."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(HERE, out, ignore=shutil.ignore_patterns("__pycache__"))
    for page in HERE.rglob("*.md"):
        copy = out / page.relative_to(HERE)
        copy.write_text(adapt(page.read_text(encoding="utf-8"), page), encoding="utf-8")
    for name in AT_THE_ROOT:
        text = (ROOT / name).read_text(encoding="utf-8")
        text = re.sub(r"\]\(docs/", "](", text)
        text = re.sub(r'(src|href)="docs/', r'\1="', text)
        (out / name.lower()).write_text(text, encoding="utf-8")
    for page in (ROOT / "examples").glob("*/README.md"):
        copy = out / page.relative_to(ROOT)
        copy.parent.mkdir(parents=True)
        text = re.sub(r"\]\((?:\.\./)+docs/", "](../../", page.read_text(encoding="utf-8"))
        copy.write_text(text, encoding="utf-8")


def main():
    """Build the site; the exit code is that of the first step that fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "docs")
    out = parser.parse_args().out.resolve()
    wrong = [line for page in links.pages() for line in links.broken(page)]
    if wrong:
        sys.exit("\n".join(wrong))
    source = out / "source"
    copy_pages(source)
    write_api(source / "api")
    write_messages(source / "messages.md")
    write_parameters(source / "parameters.md")
    shutil.rmtree(out / "html", ignore_errors=True)
    strict = ["-W", "--keep-going", "-n", "-q", "-j", "2", "-E", "-d", str(out / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *strict, str(source), str(out / "html")]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    if done.returncode == 0:
        print(f"{out / 'html' / 'index.html'}")
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
