"""Write constraints.txt from environments in which the tests pass.

    python scripts/lock.py ENV311/bin/python ENV312/bin/python ...

Each argument is the Python of an environment after ``pip install -e '.[test]'``. Packages whose version depends on the
Python get a marker. No download addresses are written.
"""

import subprocess
import sys
from pathlib import Path

HEADER = """\
# Versions the tests passed with; `pip install -c constraints.txt cfb_mjx` reproduces them.
# Written by scripts/lock.py. The ranges that are meant to work are in pyproject.toml.
"""


def frozen(python: str) -> tuple[str, dict[str, str]]:
    """Return the Python version (``3.11``) and the installed packages of an environment."""
    version = subprocess.check_output([python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], text=True)
    lines = subprocess.check_output([python, "-m", "pip", "freeze", "--exclude-editable"], text=True).split()
    return version.strip(), dict(line.split("==") for line in lines if line.count("==") == 1)


def main(pythons: list[str]) -> None:
    """Merge the environments and write constraints.txt."""
    environments = dict(frozen(python) for python in pythons)
    lines = []
    for name in sorted(set().union(*environments.values()), key=str.lower):
        by_version: dict[str, list[str]] = {}
        for python, packages in environments.items():
            if name in packages:
                by_version.setdefault(packages[name], []).append(python)
        if len(by_version) == 1:
            lines.append(f"{name}=={next(iter(by_version))}")
            continue
        for version, found_on in by_version.items():
            marker = " or ".join(f"python_version == '{python}'" for python in found_on)
            lines.append(f"{name}=={version} ; {marker}")
    Path(__file__).resolve().parents[1].joinpath("constraints.txt").write_text(HEADER + "\n".join(lines) + "\n")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(sys.argv[1:])
