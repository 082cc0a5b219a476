"""Separate instances: applications that run another version beside the default version.

With ``versions: separate`` in the appdef, a demand for a version other than the default gets an
application of its own. This application has the version in its id (``edge/fusion@1.1.0``), so its
services, topics and connections have names of their own. It is removed with its last claim. A
service that several appdefs share still runs only once, for all versions.

With ``versions: separate``, a claim records the version, not the channel that the demand named. It
does so for the default version too. If claims recorded the channel, a channel that moves to another
version would change an application that others share.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from demandops.config.config import Config
from demandops.demand.application import Application
from demandops.demand.demand_request import AnyRequest, DemandRequest


def with_separate_instances(request: AnyRequest, config: Config) -> AnyRequest:
    """Return the request with separate instances for versions other than the default."""
    demanded = (
        replace(item, held=_separated(item.held, config))
        if isinstance(item.held, Application) and item.held.version
        else item
        for item in request.demanded
    )
    return replace(request, demanded=tuple(demanded))


def _separated(app: Application, config: Config) -> Application:
    appdef = config.appdefs.get(app.appdef)
    versions = config.application_versions.get(app.appdef, {})
    version = versions.get(app.version)
    if appdef is None or appdef.versions != "separate" or version is None:
        return app
    # two names of one version have the same rank
    if version.rank == versions[""].rank:
        return replace(app, version=version.name)
    suffix = f"@{version.name}"
    id = app.id if app.id.endswith(suffix) else f"{app.id}{suffix}"
    return replace(app, id=id, version=version.name, separate=True)


def notes(request: DemandRequest) -> Iterator[str]:
    """Yield a note for each separate instance that a request lists."""
    for item in request.demanded:
        if isinstance(item.held, Application) and item.held.separate:
            id, _, version = item.held.id.rpartition("@")
            yield f"application '{id}' in version {version} runs separately, as '{item.held.id}'"
