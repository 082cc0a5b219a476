"""Which connection carries each route of a demand, and when a route ends with what needed it.

A route is its topic at both ends (:class:`RouteKey`), and at most one connection carries it. So a
topic reaches a node once, whoever asks for it and in whichever order. The claims record the
choice: what carries a route does not change while anybody holds it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from operator import attrgetter

from demandops.base.naming import SubjectKind, TopicKey, hash_of, id_problem, topic_problem
from demandops.base.quoting import quoted
from demandops.connections.connection import Connection, Route, RouteKey, faults
from demandops.connections.connection_types import type_named
from demandops.decide.admission.admission import choose_type
from demandops.decide.planning.flows import Flow, flows, is_bridged
from demandops.model.config.config import BROKERS_FILE, Config
from demandops.model.demand.demand import AnyDemand, Application, Connect, Demand, Item, Operation
from demandops.model.ledger.claim import Claim, ClaimKey, demand_id
from demandops.model.ledger.ledger import ClaimChange, Ledger, World

# ---- implied routes: those that a demand's applications need, and that it does not list ----


def with_implied_routes(request: AnyDemand, ledger: Ledger, config: Config) -> AnyDemand:
    """Return the request with each route that its applications need, on no connection yet."""
    brought = {
        key[2:]
        for item in request.demanded
        if isinstance(item.held, Connection)
        for key in map(item.held.key_of, item.held.topics)
    }
    demanded = list(request.demanded)
    standing = _StandingRoutes(ledger)
    for item in request.demanded:
        app = item.held
        if not isinstance(app, Application) or (app.connect.type == "none" and not app.held_for):
            continue
        demand = request.demand or demand_id(request.id, item.requesters)
        places: dict[TopicKey, str] = {
            (role, topic.topic, topic.source): f"inputs.{role}[{index}]"
            for role, topics in app.inputs.items()
            for index, topic in enumerate(topics)
        }
        for flow in flows(config, app):
            # Admission reports an unknown node and a topic that is not valid
            is_valid = (
                flow.key.sender in config.domain_of
                and flow.key.receiver in config.domain_of
                and not topic_problem(flow.key.topic)
                and not topic_problem(flow.key.target)
            )
            if not is_valid or flow.key[2:] in brought:
                continue
            topic = flow.key.topic
            if former := standing.serving(flow, request, demand):
                claim, served = former
                # an earlier goal of a demand that adds to what it holds may have listed the route
                is_join = request.operation == "join"
                if is_join and claim.demand == demand and not served.implied:
                    continue
                topic = served.read_topic
            elif app.connect.type == "none":
                continue  # held for its readers, with the connections that bring its inputs now
            place = places.get(flow.root, "node")
            if flow.delivery is not None:
                place = f"deliver[{flow.delivery}]"
            connect = Connect() if app.connect.type == "none" else app.connect
            connection = _implied(flow, connect, Route(topic, flow.key.target))
            place = item.places[0] if item.places else f"{item.field}.{place}"
            more = Item(connection, item.requesters, item.field, (place,), is_listed=False)
            demanded.append(more)
    return replace(request, demanded=tuple(demanded))


def _implied(flow: Flow, connect: Connect, route: Route) -> Connection:
    kind = None if connect.type == "auto" else type_named(connect.type)
    type = route.type or (flow.type if kind and kind.needs_types else "")
    route = replace(route, type=type, implied=True)
    broker = "" if id_problem(connect.broker) else connect.broker  # admission refuses it
    return Connection("", kind, flow.key.sender, flow.key.receiver, broker, (route,))


_ORDER = attrgetter("subject.id", "demand")  # of the keys of claims


@dataclass(slots=True)
class _StandingRoutes:
    ledger: Ledger
    _by_target: dict[ClaimKey, dict[tuple[str, ...], list[tuple[RouteKey, Route]]]] = field(
        default_factory=dict
    )

    def serving(self, flow: Flow, request: Demand, demand: str) -> tuple[Claim, Route] | None:
        """Return the claim and route that bring an input already, perhaps by another source name.

        A connection may give a topic of its source the name that applications know. A route with
        the flow's own name goes before such a route, and one of the demand before one of others.
        """
        is_join, same = request.operation == "join", flow.key
        bringing = self.ledger.keys_with("brings", same.receiver, same.target)
        exact = sorted(self.ledger.keys_with("route", *same), key=_ORDER)[:1]
        # thousands of claims may bring a topic, mostly by this very route
        others = bringing if not exact else ()
        for holders in ([each for each in bringing if each.demand == demand], exact, others):
            found = []
            for claim in filter(None, map(self.ledger.get, sorted(holders, key=_ORDER))):
                if claim.key not in self._by_target:
                    by_target = self._by_target[claim.key] = {}
                    for keyed in claim.connection.keyed():
                        by_target.setdefault(keyed[0][2:], []).append(keyed)
                for key, route in self._by_target[claim.key].get(same[2:], ()):
                    was_listed = claim.demand == demand and not route.implied
                    # from another node, only an earlier goal of the demand itself brings it
                    if key.sender != same.sender and not (is_join and was_listed):
                        continue
                    # a put gives up what it listed and lists no longer
                    by_name = "." in flow.name or flow.delivery is not None
                    if key.topic != same.topic and (by_name or (was_listed and not is_join)):
                        continue
                    found.append((key != same, claim.subject.id, claim, route))
            if found:
                *_, claim, route = min(found, key=lambda each: each[:2])
                return claim, route
        return None


# ---- carriers: each route of a demand gets its connection ----


def with_carriers(request: AnyDemand, ledger: Ledger, config: Config) -> AnyDemand:
    """Return the request with each route on the connection that carries it.

    A route stays where this demand has it. Else the initial deployment may carry it, and nothing
    is booked. Else it joins the connection that has it, whichever connection the demand lists.
    Else it is new: on the listed connection, or on a derived one, of the first type that fits. A
    connection stays as it is: another type or broker than demanded gives a note.
    """
    carriers = _Carriers(request, ledger, config)
    for item in request.demanded:
        listed = item.held
        # admission refuses what is not well formed, wherever its routes could go
        if (
            isinstance(listed, Connection)
            and listed.topics
            and not (item.is_listed and id_problem(listed.id))
            and not (listed.broker and id_problem(listed.broker))
            and not any(faults("topics", listed.topics))
        ):
            for index, route in enumerate(listed.topics):
                carriers.place(item, listed, index, route)
        else:
            carriers.items.append(item)
    demanded, notes = list[Item](), dict.fromkeys((*request.notes, *carriers.notes))
    for each in carriers.items:
        item = each if isinstance(each, Item) else carriers.united(*each)
        connection = item.held
        if isinstance(connection, Connection):
            # that of a claimed connection stays: with a new broker or node property the choice
            # would be another, and the request would contradict the other claims
            kind = connection.type or choose_type(connection, config)
            named, broker = connection.broker, ""
            if kind and named and not id_problem(named):
                broker = kind.broker_node(connection, config)
            if broker not in ("", named):
                notes[
                    f"connection '{connection.id}' uses the broker on '{broker}', because "
                    f"{config.place_of(BROKERS_FILE)} has none on {quoted(named)}"
                ] = None
            connection = replace(connection, type=kind, broker=broker or named)
        demanded.append(replace(item, held=connection))
    return replace(request, demanded=tuple(demanded), notes=tuple(notes))


@dataclass(slots=True)
class _Carriers:
    """What the routes of a request are carried by; each is placed after those before it."""

    _request: Demand
    _ledger: Ledger
    _config: Config
    notes: list[str] = field(default_factory=list)
    # The items in their order. A key stands for all that a demand has on one connection: that
    # connection without topics, and the demand.
    items: list[Item | tuple[Connection, str]] = field(default_factory=list)
    _routes: dict[tuple[Connection, str], list[tuple[Item, str, Route]]] = field(
        default_factory=dict
    )
    _above: dict[RouteKey, tuple[Connection, Route]] = field(default_factory=dict)
    _standing: dict[str, Connection] = field(default_factory=dict)

    def place(  # noqa: PLR0912, PLR0915 - one story, from the carrier to how it carries the route
        self, item: Item, listed: Connection, index: int, route: Route
    ) -> None:
        key, request = listed.key_of(route), self._request
        demand = request.demand or demand_id(request.id, item.requesters)
        holding = self._ledger.keys_with("route", *key)
        own = [each for each in holding if each.demand == demand]
        current: Route | None = None
        if not own and key in self._above:
            carrier, current = self._above[key]
        elif not own and is_bridged(key, self._config):
            self.notes.append(
                f"the initial deployment already carries {key.topic} from '{key.sender}' to "
                f"'{key.receiver}' (bridged in the inventory), so no connection carries it"
            )
            return
        elif claim := self._ledger.get(min(own or holding, key=_ORDER)) if holding else None:
            carrier, current = claim.connection, claim.connection.route_of(key)
        else:
            carrier = listed if listed.id else self._derived(listed, route)
        header = self._header(carrier.id)
        if header is None:
            wanted = listed if carrier.id == listed.id else carrier
            booked = self._ledger.connection(carrier.id)
            kind = wanted.type or (booked.type if booked else None)
            header = self._standing[carrier.id] = replace(wanted, type=kind, topics=())
        elif current is None and header.nodes != listed.nodes:
            header = replace(listed, topics=())  # a contradiction, which the booking refuses
        elif current and {*header.nodes} != {*carrier.nodes}:
            header = replace(carrier, topics=())  # as well
        is_elsewhere = item.is_listed and header.id != listed.id
        if current and route.implied:
            booked_route = replace(current, implied=True, listed="")
        else:
            booked_route = replace(route, listed=listed.id if is_elsewhere else "")
        # from the source of its carrier to the target, or back
        turned = (key.topic, key.target, False)
        if header.source == header.target:
            same = current or booked_route
            turned = (same.source, same.target, same.reverse)
        elif header.source != key.sender:
            turned = (key.target, key.topic, True)
        source, target, reverse = turned
        booked_route = replace(booked_route, source=source, target=target, reverse=reverse)
        differs, kind = "", header.type
        if kind and listed.type not in (None, kind):
            differs = f", by {kind} instead of {listed.type}"
        elif kind and listed.broker:
            broker = kind.broker_node(header, self._config)
            asked = kind.broker_node(replace(listed, type=kind), self._config)
            if broker != asked:
                differs = f", at the broker on '{broker}' instead of '{asked}'"
        if is_elsewhere or differs:
            what = f" of connection '{listed.id}'" if item.is_listed else ""
            by = "" if header.id == listed.id else f" by connection '{header.id}'"
            self.notes.append(f"{key.topic}{what}: carried{by}{differs}")
        self._above.setdefault(key, (header, booked_route))
        if (header, demand) not in self._routes:
            self.items.append((header, demand))
        place = item.places[index] if item.places else f"{item.field}.topics[{index}]"
        self._routes.setdefault((header, demand), []).append((item, place, booked_route))

    def _header(self, id: str) -> Connection | None:
        """Return the connection as it stands, without topics; None if the request may shape it."""
        if id not in self._standing:
            held = [
                claim.connection
                for claim in self._ledger.connection_claims(id)
                # a put may change what it alone holds
                if self._request.operation != "put" or claim.demand != self._request.demand
            ]
            if not held:
                return None
            broker = next((connection.broker for connection in held if connection.broker), "")
            self._standing[id] = replace(held[0], broker=broker, topics=())
        return self._standing[id]

    def _derived(self, listed: Connection, route: Route) -> Connection:
        key = listed.key_of(route)
        kind = listed.type or choose_type(replace(listed, topics=(route,)), self._config)
        id = f"derived/{key.sender}/{key.receiver}"
        if kind is not None:
            id = kind.derived_id(key)
            other = self._header(id)
            # a connection that somebody lists, or between other nodes, may have the same id
            same = (kind, listed.nodes) if not kind.one_derived_route else None
            if other and (other.type, other.nodes) != same:
                id = f"derived/{hash_of(json.dumps([kind.word, *key]), 20)}"
        return replace(listed, id=id, type=kind)

    def united(self, header: Connection, demand: str) -> Item:
        items, places, topics = zip(*self._routes[header, demand], strict=True)
        listing = [item for item in items if item.is_listed and item.held.id == header.id]
        first: Item = (listing or items)[0]
        held = replace(header, topics=topics)
        return replace(first, held=held, places=places, is_listed=bool(listing))


# ---- a connection that does not suit the others ----


def brought_twice(connection: Connection, ledger: Ledger) -> Iterator[tuple[int, str]]:
    """Yield (index, words) for each route to a topic that another route brings to the node too."""
    keys = [connection.key_of(route) for route in connection.topics]
    own: dict[tuple[str, ...], list[RouteKey]] = {}
    for key in keys:
        own.setdefault(key[2:], []).append(key)
    for index, key in enumerate(keys):
        holders = ledger.keys_with("route", *key)
        rivals = [(other, connection.id) for other in own[key[2:]] if other != key]
        bringing = ledger.keys_with("brings", key.receiver, key.target)
        # thousands of claims may bring the topic, and mostly all by this route
        for holder in bringing if len(bringing) > len(holders) and not rivals else ():
            if holder in holders or (claim := ledger.get(holder)) is None:
                continue
            others = (other for other, _ in claim.connection.keyed() if other[2:] == key[2:])
            rivals += ((other, holder.subject.id) for other in others)
        if rivals:
            rival, id = min(rivals)
            yield (
                index,
                f"{quoted(key.target)} comes to {quoted(key.receiver)} from {quoted(key.sender)} "
                f"by connection {quoted(connection.id)}, and from {quoted(rival.sender)} by "
                f"connection {quoted(id)}",
            )


def chosen_twice(
    connection: Connection, apps: Iterable[Application], ledger: Ledger
) -> Iterator[tuple[int, str]]:
    """Yield those of :func:`brought_twice` that follow from a node, and not from a listed input.

    A requester may demand two sources of a topic, but the generator chooses no node because of
    which there are two.
    """
    inputs = {(topic.source, topic.topic) for app in apps for _, topic in app.all_inputs()}
    for index, words in brought_twice(connection, ledger):
        route = connection.topics[index]
        key = connection.key_of(route)
        if route.implied and (key.sender, key.topic) not in inputs:
            yield index, words


# ---- moves: when an application moves, its routes follow, with type and options ----


def with_moved_routes(world: World, claim: Claim, moved: Application) -> Ledger:
    """Return the ledger in which a demand's routes follow an application.

    ``claim`` is on the application before the move. What it no longer needs stays for
    :func:`without_idle_routes`.
    """
    config, ledger, app = world.config, world.ledger, claim.application
    if app.connect.type == "none":
        return ledger
    old, new = flows(config, app), flows(config, moved)
    stays = {flow.key for flow in old} & {flow.key for flow in new}
    former: dict[tuple[str, str], tuple[Connection, Route]] = {}
    for flow in old:
        if flow.key in stays:
            continue
        for held, route in carrying(ledger, claim.demand, flow):
            former[flow.key.topic, flow.key.target] = (held.connection, route)
            # What a goal of the reference's action listed ends with the shutdown that lists it.
            if not held.joined and not route.implied:
                topics = tuple(
                    replace(each, implied=True) if each == route else each
                    for each in held.connection.topics
                )
                marked = replace(held, held=replace(held.connection, topics=topics))
                ledger = ledger.replace(held.key, marked)
    items = []
    for flow in new:
        if flow.key in stays:
            continue
        connect, route = app.connect, Route(flow.key.topic, flow.key.target)
        if like := former.get((flow.key.topic, flow.key.target)):
            # as it was carried before the move, perhaps under another name at its source
            source = like[1].read_topic
            route = replace(
                like[1], source=source, target=flow.key.target, reverse=False, listed=""
            )
            kind = like[0].type
            connect = Connect(kind.word if kind else "auto", like[0].broker)
        items.append(Item(_implied(flow, connect, route), claim.requesters, is_listed=False))
    operation: Operation = "join" if claim.joined else "put"
    put = Demand(operation, claim.request, tuple(items), claim.demand)
    for item in with_carriers(put, ledger, config).demanded:
        booked = replace(claim, held=item.held.booked())
        if current := ledger.get(booked.key):
            more = current.connection.extended(booked.connection).booked()
            booked = replace(current, held=more)
        ledger = ledger.replace(booked.key, booked)
    return ledger


def carrying(ledger: Ledger, demand: str, flow: Flow) -> Iterator[tuple[Claim, Route]]:
    sender, _, *brought = flow.key
    for claim in ledger.claims_with("brings", *brought):
        for key, route in claim.connection.keyed() if claim.demand == demand else ():
            if [key.sender, *key[2:]] == [sender, *brought]:
                yield claim, route


# ---- the end: an implied route goes when none of its demand's applications needs it ----


def without_idle_routes(
    ledger: Ledger, config: Config, changes: Iterable[ClaimChange]
) -> tuple[Ledger, list[ClaimKey]]:
    """Return the ledger without the implied routes that the changed demands need no longer."""
    keys = list[ClaimKey]()
    for demand in dict.fromkeys(
        change.key.demand
        for change in changes
        if change.key.subject.kind is SubjectKind.APPLICATION
        and change.before
        and not change.only_renews
    ):
        claims = ledger.claims_with("demand", demand)
        needed = {
            (flow.key.sender, *flow.key[2:])
            for claim in claims
            if claim.is_on_application
            for flow in flows(config, claim.application)
        }
        for claim in claims:
            if claim.is_on_application:
                continue
            idle = {
                (route.source,)
                for key, route in claim.connection.keyed()
                if route.implied and (key.sender, *key[2:]) not in needed
            }
            if idle:
                ledger = ledger.replace(claim.key, claim.without_topics(idle))
                keys.append(claim.key)
    return ledger, keys


# ---- older ledgers: several connections may carry a route, and the oldest keeps it ----


def with_one_carrier(ledger: Ledger) -> tuple[Ledger, list[ClaimKey]]:
    holders = dict[RouteKey, set[str]]()
    for claim in ledger:
        for key, _ in () if claim.is_on_application else claim.connection.keyed():
            holders.setdefault(key, set()).add(claim.subject.id)
    keys = list[ClaimKey]()
    for route_key, ids in sorted(holders.items()):
        if len(ids) < 2:
            continue
        since = {id: min(c.booked for c in ledger.connection_claims(id)) for id in ids}
        oldest = min(ids, key=lambda id: (since[id], id))
        carrier = ledger.connection(oldest)
        assert carrier is not None  # noqa: S101 - it has claims
        on_oldest = (c.connection.route_of(route_key) for c in ledger.connection_claims(oldest))
        standing = next(filter(None, on_oldest))
        for claim in (c for id in sorted(ids - {oldest}) for c in ledger.connection_claims(id)):
            double = claim.connection.route_of(route_key)
            if double is None:
                continue
            listed = "" if double.implied else double.listed or claim.subject.id
            on = replace(standing, implied=double.implied, listed=listed)
            moved = replace(claim, held=replace(carrier, topics=(on,)))
            if current := ledger.get(moved.key):
                moved = replace(
                    current, held=moved.connection.extended(current.connection).booked()
                )
            ledger = ledger.replace(moved.key, moved)
            ledger = ledger.replace(claim.key, claim.without_topics({(double.source,)}))
            keys += [moved.key, claim.key]
    return ledger, keys
