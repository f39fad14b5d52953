#!/usr/bin/python3
"""Writes the C++ examples of a page as files, so that a test compiles what readers copy.

    examples_of_page.py PAGE.md FOLDER

Each block of C++ is the file that the text before it names last: a header, `include/pulmo/...`, or lines of
`src/physics/registry.cpp`. FOLDER gets the headers and `registered.hpp`, the registry with these lines.
"""
import re
import sys
from pathlib import Path

REGISTRY = "src/physics/registry.cpp"


def examples(text):
    """(file, code) of each block, in order."""
    end = 0
    for block in re.finditer(r"^```cpp\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        named = re.findall(r"`((?:include|src)/[\w/]+\.[ch]pp)`", text[end:block.start()])
        if not named:
            sys.exit(f"no file is named before the block that begins with: {block[1].splitlines()[0]}")
        yield named[-1], block[1]
        end = block.end()


def main():
    page, folder = Path(sys.argv[1]), Path(sys.argv[2])
    headers, lines = [], []
    for name, code in examples(page.read_text(encoding="utf-8")):
        if name == REGISTRY:
            lines.append(code)
            continue
        header = name.removeprefix("include/")
        if header in headers:
            sys.exit(f"two blocks are {name}")
        headers.append(header)
        path = folder / header
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(code, encoding="utf-8")
    if not headers or len(headers) != len(lines):
        sys.exit(f"{page}: {len(headers)} headers, {len(lines)} lines of {REGISTRY}: each header has one")
    includes = "".join(f'#include "{header}"\n' for header in headers)
    (folder / "registered.hpp").write_text(
        f"""/// @file
/// What {page.name} adds to the registry.
#pragma once

{includes}
#include "pulmo/physics/registry.hpp"

namespace pulmo::test {{

inline Registry registry_of_the_page()
{{
Registry r = Registry::standard();
{''.join(lines)}return r;
}}

}} // namespace pulmo::test
""", encoding="utf-8")


if __name__ == "__main__":
    main()
