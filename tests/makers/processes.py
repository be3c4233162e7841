"""Find processes, by Linux's /proc."""

from pathlib import Path


def commands(*words: str) -> list[tuple[int, int]]:
    """List the processes whose command line holds all these words: their number, and that of the process that started them."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            line = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
        except OSError:  # it has ended
            continue
        if all(word in line for word in words):
            found.append((int(folder.name), int(parent)))
    return found


def of_session(session: int) -> dict[int, str]:
    """Return the command lines of the processes of a session by their numbers, except those that have ended."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, of = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(of) == session and state != "Z":
                found[int(folder.name)] = (
                    (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                )
        except OSError:  # it has ended
            continue
    return found
