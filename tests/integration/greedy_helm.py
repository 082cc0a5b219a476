"""A stand-in for helm that does everything helm must have no occasion to do.

It follows links, fetches what texts name, unpacks archives, runs programs of the chart, and writes
where it may. It says so as an error, so that a test also sees what the kernel prevented.
"""

import os
import re
import subprocess
import sys
import tarfile
import urllib.request
from contextlib import suppress
from pathlib import Path


def main() -> None:
    chart = next(Path(each) for each in sys.argv if Path(each).is_dir())
    done = [f"knows {name}" for name in os.environ if "SECRET" in name]
    for folder, folders, names in os.walk(chart, followlinks=True):
        for path in (Path(folder, name) for name in (*folders, *names)):
            if path.is_symlink():
                done.append(f"follows {path.name}")
            if path.suffix == ".tgz":
                done.append(f"unpacks {path.name}")
                with suppress(Exception), tarfile.open(path) as archive:
                    archive.extractall(path.parent)
            if path.is_file() and os.access(path, os.X_OK):
                done.append(f"runs {path.name}")
                with suppress(Exception):
                    subprocess.run([str(path)], check=False)
            if path.name == "values.schema.json":
                done.append("validates")
                for address in re.findall(r"(?:http|file)://[^\"]+", path.read_text()):
                    with suppress(Exception):
                        urllib.request.urlopen(address, timeout=1)  # noqa: S310 - greedy
    Path("written").write_text("into the working directory")
    Path.home().joinpath("written").write_text("into the home folder")
    if done:
        sys.exit(f"Error: GREEDY {', '.join(done)}")


if __name__ == "__main__":
    main()
