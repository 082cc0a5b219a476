"""Warnings about patterns of the policy that match nothing now.

Such a pattern is misspelled, or what it matches was removed or does not exist yet. Patterns of
requesters are not checked: the state repo has no list of requesters.
"""

from __future__ import annotations

from collections.abc import Iterator

from demandops.config.config import DOMAINS_FILE, Config
from demandops.config.policy import matches
from demandops.errors import Fault, fault, suggestion
from demandops.quoting import quoted


def warnings(config: Config) -> Iterator[Fault]:
    nodes = tuple(sorted(config.nodes))
    for name, domain in sorted(config.domains.items()):
        own = tuple(sorted(id for id, of in config.domain_of.items() if of.name == name))
        others = tuple(sorted(config.domains.keys() - {name}))
        # (field, patterns, what the patterns may match, all names that they may match)
        kinds = [("nodes", domain.nodes, "node", nodes)]
        for rule in domain.rules:
            place = f"rule '{rule.name}'"
            appdefs, brokers = (*config.appdefs,), (*config.brokers,)
            kinds += [
                (f"{place}: applications", rule.applications, "application definition", appdefs),
                (f"{place}: nodes", rule.nodes, "node of the domain", own),
                (f"{place}: brokers", rule.brokers, "broker", brokers),
                (f"{place}: peers", rule.peers, "other access domain", others),
            ]
        file = config.file_of(DOMAINS_FILE, name)
        for field, patterns, what, names in kinds:
            for pattern in patterns:
                if pattern != "*" and not any(matches(each, (pattern,)) for each in names):
                    hint = suggestion(pattern, names) or "; there is none"
                    message = f"{quoted(pattern)} matches no {what}{hint}"
                    yield fault(f"access domain '{name}', {field}", message).within(file)
