"""While a configuration is not valid, that of the newest valid commit is in effect.

After a restart the same is in effect, and every commit verifies by its trailers.
"""

from __future__ import annotations

import subprocess
from contextlib import suppress
from pathlib import Path
from random import Random

import pygit2
import pytest
import yaml
from demandops.base.errors import DemandOpsError, Refused
from demandops.base.settings import GENERATED_ROOTS
from demandops.repo.history import commit_log
from demandops.repo.load import snapshot as snapshots
from demandops.serve.generator import Generator

from tests.kit import plain_yaml, rig
from tests.kit.chance import IN_FULL
from tests.kit.config import override
from tests.kit.repo import GitRepo, differing
from tests.kit.repo import read as text
from tests.kit.rig import Person, goal

TABLES = plain_yaml.beside(__file__)
CLUSTERS, NODES, IMAGES = "inventory/clusters.yaml", "inventory/nodes.yaml", "registry/images.yaml"
DETECTION = "clusters/c-its/perception/edge/od-edge-station00.yaml"
TWO = override({"services": ["object-detection"], "nodes": ["edge"]}, replicas=2)


def values(bare: Path) -> tuple[str, int]:
    found = yaml.safe_load(text(bare, DETECTION))["spec"]["values"]
    return found["image"]["tag"], found["replicas"]


def tagged(bare: Path, new: str, kind: str = "Images") -> str:
    images = yaml.safe_load(text(bare, IMAGES)) | {"kind": kind}
    images["images"]["object-detection"]["tag"] = new
    return yaml.safe_dump(images)


def _change(random: Random, bare: Path, nodes: str) -> dict[str, str | None]:
    """Return a random change that is valid, breaks a file, or removes what demands need."""
    start, end = nodes.index("  - id: vehicle01\n"), nodes.index("  - id: vehicle02\n")
    claim = random.choice([path for path in rig.claims(bare) if "applications" in path])
    number, fields = random.choice([*enumerate(TABLES["overrides"])])
    name = f"overrides/{number}.yaml"
    changes: list[dict[str, str | None]] = [
        {name: override(**fields)},
        {name: None} if text(bare, name) else {"README.md": "Ours\n"},
        {IMAGES: tagged(bare, f"v{random.randint(1, 9)}")},
        {IMAGES: tagged(bare, "v1", "Imags")},
        {NODES: nodes[:start] + nodes[end:]},
        {NODES: nodes},
        {claim: "kind: nonsense\n"},
        {claim: text(bare, claim).replace("node: edge\n", "node: nowhere\n")},
        {claim: None},
    ]
    first, second = random.sample(changes[:6], 2)
    chosen = (
        first | second if random.random() < 0.3 else random.choice([*changes[:1] * 4, *changes])
    )
    return {**chosen, "notes.md": str(random.random())}


@pytest.mark.parametrize("mistakes", TABLES["mistakes"].values(), ids=TABLES["mistakes"])
@pytest.mark.parametrize("how", ["push", "pull"])
def test_the_printed_revert_mends_main(
    generator: Generator, bare: Path, person: Person, how: str, mistakes: list[list[str]]
) -> None:
    person.change({CLUSTERS: f"# Earlier, and valid\n{text(bare, CLUSTERS)}"})
    rig.book(generator, goal(1))
    before = text(bare, CLUSTERS)
    person.fetch()
    file = person.folder / CLUSTERS
    for old, new in mistakes:
        file.write_text(file.read_text().replace(old, new))
        rig.git(person.folder, "commit", "-q", "-a", "-m", "A mistake")
    if how == "pull":
        person.change({"overrides/two.yaml": TWO})
        rig.book(generator, goal(2))
        rig.git(person.folder, "pull", "-q", "--no-rebase", "--no-edit")
    rig.git(person.folder, "push", "-q", "origin", "HEAD:main")
    rig.book(generator, goal(3))
    repo = pygit2.Repository(str(bare))
    _, _, revert = snapshots.how_to_mend(repo, generator.snapshot).partition("commits: git ")
    person.fetch()
    rig.git(person.folder, *revert.split())
    rig.git(person.folder, "push", "-q", "origin", "HEAD:main")
    rig.book(generator, goal(4))
    assert generator.snapshot.problems == ()
    assert text(bare, CLUSTERS) == before
    assert bool(text(bare, "overrides/two.yaml")) is (how == "pull")
    assert differing(bare) == {}


def test_what_a_generator_booked_in_a_fork_is_a_persons_edit(
    bare: Path, person: Person, tmp_path: Path
) -> None:
    """And what was booked here is not, though the quota is full by now."""
    policy, fork = "policy/access-domains.yaml", tmp_path / "fork.git"
    with rig.running(bare) as generator:
        rig.book(generator, goal(1))
        rig.git(tmp_path, "clone", "-q", "--bare", "--no-local", str(bare), str(fork))
        rig.book(generator, goal(2))
        full = yaml.safe_load(text(bare, policy))
        for domain in full["domains"]:
            domain["quotas"] = {"servicesPerNode": 2}
        person.change({policy: yaml.safe_dump(full)})
        with rig.running(fork) as other:
            rig.book(other, goal(3))
        person.fetch()
        rig.git(person.folder, "fetch", "-q", str(fork), "main:fork")
        rig.git(person.folder, "merge", "-q", "-X", "ours", "-m", "Merge the fork", "fork")
        rig.git(person.folder, "push", "-q", "origin", "HEAD:main")
        alone = snapshots.state_at(pygit2.Repository(str(bare)), rig.tip(bare)).state
        with pytest.raises(Refused, match="servicesPerNode"):
            generator.submit(goal(0)).future.result(rig.PATIENCE_S)
        wanted = rig.books_after([goal(1), goal(2)])["services"]
        assert {*rig.books(bare)["services"]} == {*wanted}
        running = generator.snapshot.state
        assert {c.key for c in alone.ledger} == {c.key for c in running.ledger}


def includes(generator: Generator, commit: str) -> bool:
    return generator.includes(str(generator.snapshot.commit), commit)


@pytest.mark.parametrize("seed", range(3 if IN_FULL else 1))
def test_a_start_at_any_commit_finds_what_the_running_generator_has(
    bare: Path, person: Person, seed: int
) -> None:
    """The history alone decides which files are in effect, for any reader at any time."""
    random, nodes = Random(seed), text(bare, NODES) + "\n"
    with rig.running(bare) as generator:
        rig.book(generator, *(goal(number) for number in range(6)))
        repo = pygit2.Repository(str(bare))
        for _ in range(15):
            files = _change(random, bare, nodes)
            made = person.change(files)
            alone = snapshots.state_at(repo, made)
            generator.fetch_now()
            rig.wait_until(lambda commit=made: includes(generator, commit), f"{made} is followed")
            running = generator.snapshot
            again = snapshots.state_at(repo, running.commit)
            for found in (alone, again):
                assert found.state.config == running.state.config, files
                assert {c.key: c for c in found.state.ledger} == {
                    c.key: c for c in running.state.ledger
                }, files
            # what `alone` has, the generator may have put back by now
            assert bool(again.problems) == bool(running.problems)
            with suppress(DemandOpsError):
                rig.book(generator, goal(random.randrange(8), shutdown=random.random() < 0.4))
        gone = dict.fromkeys(GitRepo(bare).files("overrides/"))
        person.change({NODES: nodes, IMAGES: tagged(bare, "v1"), **gone})
        rig.book(generator, goal(9))
        assert generator.snapshot.problems == ()
    left = GitRepo(bare).files()
    assert not [path for path in left if path.startswith(("overrides/", "ledger/overrides/"))]
    assert not [path for path, one in left.items() if "# override " in one or "override:" in one]
    rig.assert_sound(bare)


def test_what_does_not_belong_in_generated_folders_is_removed_whatever_it_is_called(
    generator: Generator, bare: Path
) -> None:
    def entries() -> set[str]:
        return {
            *rig.git(bare, "ls-tree", "-rz", "--name-only", "main", *GENERATED_ROOTS).split("\0")
        }

    rig.book(generator, goal(1))
    before = entries()
    lines = [
        "commit refs/heads/main",
        "committer P <p@example.org> 1767225600 +0000",
        "data 4\nevil",
        "from refs/heads/main^0",
        "M 100644 inline clusters/a/README.md",
        "data 2\na\n",
    ]
    for line in TABLES["foreign"]:
        mode, _, path = line.replace("DEEP", "deep/" * 3000).partition(" ")
        what = "1" * 40 if mode == "160000" else "inline"
        lines += [f"M {mode} {what} {path}", *(["data 5\nevil\n"] if what == "inline" else [])]
    text = "\n".join(lines).encode()
    subprocess.run(["git", "-C", bare, "fast-import", "--quiet"], input=text, check=True)
    rig.book(generator, goal(2))
    assert {one for one in entries() - before if not one.endswith(".yaml")} == {
        "clusters/a/README.md"
    }
    assert not any("evil" in one or "link" in one or "377" in one for one in entries())
    rig.assert_sound(bare)


def test_broken_files_are_judged_once_and_not_on_each_demand(
    generator: Generator, bare: Path, person: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[int] = []
    asked: list[object] = []
    load, origin_of = snapshots.load_config, commit_log.fault_origin
    monkeypatch.setattr(
        commit_log, "fault_origin", lambda *args: (asked.append(args), origin_of(*args))[1]
    )
    monkeypatch.setattr(
        snapshots, "load_config", lambda files: (parsed.append(len(files)), load(files))[1]
    )
    rig.book(generator, goal(1))
    nodes = "".join(f"  - {{id: n{i}, type: [], cluster: 5}}\n" for i in range(2_000))
    person.change({f"overrides/o{number:03}.yaml": "a: [" for number in range(150)})
    person.change({NODES: text(bare, NODES) + nodes})
    rig.book(generator, goal(2))
    faults = [one for one in generator.snapshot.problems if one.file == NODES]
    assert (len(faults), faults[-1].message) == (101, "has 3900 more faults")
    assert len(generator.snapshot.problems) == 251
    judged = len(parsed)
    assert judged
    assert asked
    asked.clear()
    rig.book(generator, goal(3), goal(4))
    assert (asked, len(parsed)) == ([], judged)
    person.change({"README.md": "Ours\n"})
    rig.book(generator, goal(5))
    assert len(parsed) == judged
    rig.assert_sound(bare)
