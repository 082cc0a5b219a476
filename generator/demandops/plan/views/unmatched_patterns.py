"""Warnings about patterns of the policy that match nothing now.

Such a pattern is misspelled, or what it matches was removed or does not exist yet.
"""

from __future__ import annotations

from collections.abc import Iterator

from demandops.config.config import DOMAINS_FILE, Config
from demandops.config.policy import AccessDomain, matches
from demandops.errors import Fault, fault, suggestion
from demandops.quoting import quoted


def warnings(config: Config) -> Iterator[Fault]:
    """Yield a warning for each pattern of an access domain that matches nothing.

    The pattern ``*`` and patterns of requesters are not checked: the state repo has no list of
    requesters.
    """
    for name, domain in sorted(config.domains.items()):
        file = config.file_of(DOMAINS_FILE, name)
        for field, pattern, what, known in _patterns(domain, config):
            if pattern != "*" and not any(matches(one, (pattern,)) for one in known):
                hint = suggestion(pattern, known) or "; there is none"
                message = f"{quoted(pattern)} matches no {what}{hint}"
                yield fault(f"access domain '{name}', {field}", message).within(file)


def _patterns(
    domain: AccessDomain, config: Config
) -> Iterator[tuple[str, str, str, tuple[str, ...]]]:
    """Yield (field, pattern, kind, names) for each pattern of an access domain.

    ``kind`` says in words what the pattern may match. ``names`` are all names that it may match.
    """
    own = tuple(sorted(id for id, of in config.domain_of.items() if of.name == domain.name))
    others = tuple(sorted(config.domains.keys() - {domain.name}))
    nodes = tuple(sorted(config.nodes))
    yield from (("nodes", pattern, "node", nodes) for pattern in domain.nodes)
    for rule in domain.rules:
        place = f"rule '{rule.name}'"
        kinds = (
            ("applications", rule.applications, "application definition", (*config.appdefs,)),
            ("nodes", rule.nodes, "node of the domain", own),
            ("brokers", rule.brokers, "broker", (*config.brokers,)),
            ("peers", rule.peers, "other access domain", others),
        )
        for field, patterns, what, known in kinds:
            yield from ((f"{place}: {field}", pattern, what, known) for pattern in patterns)
