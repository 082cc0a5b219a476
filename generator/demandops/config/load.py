"""Loading of the configuration: the files' texts become a :class:`Config`.

Pure. If any file has a fault, the whole configuration is rejected, with every fault of every file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePosixPath
from types import MappingProxyType
from typing import TypeVar

from demandops.config.appdef import (
    ApplicationDefinition,
    ServiceDefinition,
    Services,
    resolved_services,
)
from demandops.config.config import (
    BROKERS_FILE,
    CHARTS_FILE,
    CLIENTS_FILE,
    CLUSTERS_FILE,
    COLLECTIONS,
    DOMAINS_FILE,
    IMAGES_FILE,
    NODES_FILE,
    VERSIONS_FILE,
    Config,
    collection_of,
)
from demandops.config.config_reader import ConfigReader
from demandops.config.cross_check import cross_check
from demandops.config.inventory import Broker, BrokersFile, Cluster, ClustersFile, Node, NodesFile
from demandops.config.override import OVERRIDES_ROOT, Override, OverrideFile
from demandops.config.policy import AccessDomain, AccessDomainsFile, matches
from demandops.config.registry import (
    DEFAULT_SETTINGS,
    Chart,
    ChartsFile,
    ClientsFile,
    Image,
    ImagesFile,
    VersionList,
    VersionsFile,
)
from demandops.config.repo_settings import ROOT_FILE, Flux, RepoSettings
from demandops.errors import InvalidInput
from demandops.settings import API_VERSION, RENDER_VERSION

Definition = TypeVar("Definition", ApplicationDefinition, ServiceDefinition)

_NAME = re.compile(r"[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?")
_ANY = RepoSettings(
    apiVersion=API_VERSION,
    kind="StateRepository",
    gitops="flux",
    renderVersion=RENDER_VERSION,
    flux=Flux(url="https://unread.invalid/repo.git"),
)  # replaces an invalid one, so that the other files can be checked


def load(files: Mapping[str, str]) -> Config:
    """Return the configuration of a state repo.

    Args:
        files: path in the state repo → text; other folders are ignored.

    Raises:
        InvalidInput: with every fault of every file.
    """
    reader = ConfigReader(files)
    repository = reader.read_file(ROOT_FILE, RepoSettings)
    if repository and repository.render_version > RENDER_VERSION:
        reader.add_fault(
            ROOT_FILE,
            "renderVersion",
            f"is {repository.render_version}, but this generator renders version "
            f"{RENDER_VERSION}; update the generator",
        )
    if repository and getattr(repository, repository.gitops) is None:
        reader.add_fault(
            ROOT_FILE,
            repository.gitops,
            f"is missing, but gitops is {repository.gitops}; add it with the url that the "
            "clusters fetch this repo from",
        )
    _refuse_unread(reader)
    nodes = reader.read_items(NODES_FILE, NodesFile, "nodes", Node, "id")
    domains = reader.read_items(DOMAINS_FILE, AccessDomainsFile, "domains", AccessDomain, "name")
    appdefs = _read_definitions(reader, "appdef.yaml", ApplicationDefinition)
    definitions = _read_definitions(reader, "service.yaml", ServiceDefinition)
    services = {name: _resolve(appdef, definitions, reader) for name, appdef in appdefs.items()}
    clients, client_files = _read_clients(reader)
    domain_of = _domains_of_nodes(reader, nodes, domains)
    config = Config(
        repo_settings=repository or _ANY,
        clusters=reader.read_items(CLUSTERS_FILE, ClustersFile, "clusters", Cluster, "name"),
        nodes={id: _in_ros_domain(node, domain_of.get(id)) for id, node in nodes.items()},
        brokers=reader.read_items(BROKERS_FILE, BrokersFile, "brokers", Broker, "node"),
        domains=domains,
        charts=reader.read_items(CHARTS_FILE, ChartsFile, "charts", Chart),
        images=_read_images(reader),
        clients=clients,
        versions=_read_versions(reader),
        appdefs=appdefs,
        definitions=definitions,
        services=MappingProxyType(services),
        domain_of=domain_of,
        files=MappingProxyType({p: text for p, text in files.items() if p.startswith("appdefs/")}),
        overrides=_read_overrides(reader),
        entry_files={**reader.entry_files(), CLIENTS_FILE: client_files},
    )
    cross_check(config, reader)
    if reader.faults:
        raise InvalidInput(dict.fromkeys(reader.faults))
    return config


def _read_images(reader: ConfigReader) -> Mapping[str, Image]:
    images = reader.read_items(IMAGES_FILE, ImagesFile, "images", Image)
    for name, image in images.items():
        head = reader.head(reader.place_of(IMAGES_FILE, name)[0], ImagesFile)
        if head is not None and head.registry is not None:
            images[name] = image.pulled_from(head.registry)
    return images


def _read_clients(reader: ConfigReader) -> tuple[ClientsFile, Mapping[str, str]]:
    """Return the settings of all files, and the file of each connection type's."""
    found, files = DEFAULT_SETTINGS, dict[str, str]()
    for file in reader.files_of(CLIENTS_FILE):
        part = reader.read_file(file, ClientsFile)
        for word in part.connection_types if part else ():
            first = files.setdefault(word, file)
            if first != file:
                reader.add_twice(word, (first, word), (file, word))
            found = found.model_copy(update={word: getattr(part, word)})
    return found, files


def _refuse_unread(reader: ConfigReader) -> None:
    """Add a fault for each file that looks like configuration and is none."""
    folders = {collection.partition("/")[0] for collection in COLLECTIONS}
    for path in sorted(reader.files):
        folder, *rest = path.split("/")
        if folder not in folders or not path.endswith((".yaml", ".yml")):
            continue
        if collection_of(path) is None and not any(part.startswith(".") for part in rest):
            known = [PurePosixPath(one).stem for one in COLLECTIONS if one.startswith(folder)]
            reader.add_fault(
                path,
                "",
                f"is not read; {folder}/ has {', '.join(sorted(known))}, each as <name>.yaml, as "
                "files <name>/*.yaml or as both; rename it, or remove it",
            )


def _read_versions(reader: ConfigReader) -> Mapping[str, VersionList]:
    if not reader.files_of(VERSIONS_FILE):
        return {}
    return reader.read_items(VERSIONS_FILE, VersionsFile, "applications", VersionList)


def _read_definitions(
    reader: ConfigReader, file: str, model: type[Definition]
) -> Mapping[str, Definition]:
    """Return the definitions in the files of this name, one in each folder of ``appdefs/``."""
    found = {}
    for path in sorted(reader.files):
        parts = path.split("/")
        if len(parts) != 3 or parts[0] != "appdefs" or parts[2] != file:
            continue
        one = reader.read_file(path, model)
        if one is None:
            continue
        if one.name != parts[1]:
            reader.add_fault(
                path, "name", f"is '{one.name}', but the folder is '{parts[1]}'; make them equal"
            )
            one = one.model_copy(update={"name": parts[1]})
        found[one.name] = one
    return MappingProxyType(found)


def _resolve(
    appdef: ApplicationDefinition,
    definitions: Mapping[str, ServiceDefinition],
    reader: ConfigReader,
) -> Services:
    """Return the services of an appdef; none if it, or a definition that it uses, is not valid."""
    files = {f"appdefs/{name}/service.yaml" for name in appdef.uses.keys() - definitions.keys()}
    if files & reader.files.keys():
        return {}
    services, problems = resolved_services(appdef, definitions)
    for where, problem in problems:
        reader.add_fault(f"appdefs/{appdef.name}/appdef.yaml", where, problem)
    return services


def _read_overrides(reader: ConfigReader) -> Mapping[str, Override]:
    overrides = {}
    for path in sorted(reader.files):
        folder, _, name = path.partition("/")
        if folder != OVERRIDES_ROOT or name.startswith(".") or name.endswith(".md"):
            continue
        stem = name.removesuffix(".yaml")
        if stem == name or not _NAME.fullmatch(stem):
            reader.add_fault(
                path,
                "",
                "is not an override file; rename it to overrides/<name>.yaml, with lower-case "
                "letters, digits and '-', or remove it",
            )
            continue
        file = reader.read_file(path, OverrideFile)
        if file is not None:
            overrides[stem] = Override.from_file(stem, file)
    return MappingProxyType(overrides)


def _in_ros_domain(node: Node, domain: AccessDomain | None) -> Node:
    """Return the node in the ROS domain of its access domain, if that has one."""
    if domain is None or domain.ros is None:
        return node
    ros = node.ros.model_copy(update={"domain_id": domain.ros.domain_id})
    return node.model_copy(update={"ros": ros})


def _domains_of_nodes(
    reader: ConfigReader, nodes: Mapping[str, Node], domains: Mapping[str, AccessDomain]
) -> Mapping[str, AccessDomain]:
    owner: dict[str, AccessDomain] = {}
    for node in nodes:
        matching = [d for d in domains.values() if matches(node, d.nodes)]
        if len(matching) > 1:
            names = " and ".join(f"'{domain.name}'" for domain in matching)
            file, place = reader.place_of(NODES_FILE, node)
            reader.add_fault(
                file,
                f"{place}.id",
                f"'{node}' is in the access domains {names}; narrow their patterns so that it is "
                "in one",
            )
        elif matching:
            owner[node] = matching[0]
    return MappingProxyType(owner)
