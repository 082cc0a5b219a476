"""Application definitions (appdefs): a YAML file and a folder define a type of application.

An appdef lists inputs, parameters and services. The services read topics of the demand and outputs
of other services. A service that an appdef defines itself runs only for applications of this
appdef. A service that several appdefs share has a file of its own (paper, section on object
detection), and each of these appdefs lists the service's name under ``uses``.
"""

from demandops.config.appdef.application_definition import ApplicationDefinition, VersionPolicy
from demandops.config.appdef.resolved_service import Service, Services, resolved_services
from demandops.config.appdef.scaling import Resource, Scaling
from demandops.config.appdef.service_definition import (
    Deployed,
    Parameter,
    Place,
    Scope,
    ServiceDefinition,
)

__all__ = [
    "ApplicationDefinition",
    "Deployed",
    "Parameter",
    "Place",
    "Resource",
    "Scaling",
    "Scope",
    "Service",
    "ServiceDefinition",
    "Services",
    "VersionPolicy",
    "resolved_services",
]
