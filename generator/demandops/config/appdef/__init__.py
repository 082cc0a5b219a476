"""Application definitions (appdefs): a YAML file and a folder define a type of application.

An appdef lists inputs, parameters and services, which read inputs of the demand and outputs of each
other. Its own services run for its applications only. A service that several types of applications
share has a file of its own (paper, section on object detection), and each of them uses it by name.
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
