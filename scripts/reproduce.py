"""Reproduce the paper and write docs/paper.md with its figures in docs/paper.

    python scripts/reproduce.py [--real FOLDER] [-o out/paper]

`cfb reproduce all` does the same without writing into docs.
"""

import argparse
import shutil
from pathlib import Path

from cfb_mjx.commands import Reproduce

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Reproduce the paper, then write the page and copy the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "out" / "paper")
    parser.add_argument("--real", type=Path)
    arguments = parser.parse_args()
    found = Reproduce(output=arguments.output, real=arguments.real).run()
    print(found)
    from cfb_mjx.files import output_folder, write_text
    from cfb_mjx.reproduce.item import markdown, names_of

    folder = output_folder(ROOT / "docs" / "paper")
    for path in names_of(found.results):
        shutil.copyfile(path, folder / path.name)
    text = markdown(found.results, found.environment, "python scripts/reproduce.py", "paper/")
    write_text(ROOT / "docs" / "paper.md", text)
    print("docs/paper.md")


if __name__ == "__main__":
    main()
