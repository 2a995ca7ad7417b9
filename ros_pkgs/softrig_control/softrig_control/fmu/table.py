"""The table of tags and attributes of modelDescription.xml, FMI 2.0 and 3.0, and which of them a file has."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree

from softrig_core.kit.file_format import FileFormat, Use

Entry = tuple[Use, str]
KINDS2 = ("Real", "Integer", "Boolean", "String", "Enumeration")
KINDS3 = (
    *("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64"),
    *("Boolean", "String", "Enumeration", "Binary", "Clock"),
)
KIND = "KIND"  # the table has this in place of each of them
_PEOPLE: Entry = ("used", "for people only")
_TOOLS: Entry = ("used", "only for tools that do more than steps with held inputs; no result depends on it")
_USED: Entry = ("used", "")

#: Of a variable or a declared type; a variable without it has that of its declared type.
_QUANTITY: dict[str, Entry] = {
    "quantity": _PEOPLE,
    "unit": ("used", "converted to the unit of the port"),
    "displayUnit": _PEOPLE,
    "relativeQuantity": ("used", "the value is a difference: the offset of its unit (degC) does not count"),
    "min": ("used", "bound of `values`"),
    "max": ("used", "bound of `values`"),
    "nominal": _TOOLS,
    "unbounded": _TOOLS,
}
_VARIABLE: dict[str, Entry] = {
    "name": _USED,
    "valueReference": _USED,
    "description": _PEOPLE,
    "causality": ("used", "which variables `inputs`, `outputs` and `values` may name"),
    "variability": ("used", "tunable: may change in a run; constant: cannot be set"),
    "initial": _TOOLS,
    "canHandleMultipleSetPerTimeInstant": _TOOLS,
    "declaredType": _USED,
    "start": ("used", "value of an input before its first message"),
    "derivative": _TOOLS,
    "reinit": _TOOLS,
    "intermediateUpdate": _TOOLS,
    "previous": _TOOLS,
    "clocks": ("ignored", "variables are read and set at every communication point, not at ticks of a clock"),
    "mimeType": _TOOLS,
    "maxSize": _TOOLS,
}
_CLOCK = """canBeDeactivated priority intervalVariability intervalDecimal shiftDecimal supportsFraction resolution
intervalCounter shiftCounter"""
_CAN = """needsExecutionTool canHandleVariableCommunicationStepSize canInterpolateInputs maxOutputDerivativeOrder
canRunAsynchronuously canBeInstantiatedOnlyOncePerProcess canNotUseMemoryManagementFunctions
providesDirectionalDerivative providesDirectionalDerivatives providesAdjointDerivatives providesPerElementDependencies
providesEvaluateDiscreteStates completedIntegratorStepNotNeeded needsCompletedIntegratorStep fixedInternalStepSize
recommendedIntermediateInputSmoothness mightReturnEarlyFromDoStep canReturnEarlyAfterIntermediateUpdate hasEventMode
providesIntermediateUpdate"""
_INTERFACE: dict[str, Entry] = {
    "modelIdentifier": _USED,
    "canGetAndSetFMUstate": ("used", "together with the next attribute: the node can return to an earlier state"),
    "canSerializeFMUstate": _USED,
    "canGetAndSetFMUState": ("used", "together with the next attribute: the node can return to an earlier state"),
    "canSerializeFMUState": _USED,
} | dict.fromkeys(_CAN.split(), _TOOLS)
_ABOUT = """modelName description author version copyright license generationTool generationDateAndTime
variableNamingConvention"""
_EXPERIMENT: dict[str, Entry] = {
    "startTime": ("ignored", "a rig and its FMU begin at 0 s"),
    "stopTime": _PEOPLE,
    "tolerance": ("used", "tolerance of the FMU's own solver"),
    "stepSize": _PEOPLE,
}


def _below(path: str, attributes: dict[str, Entry], entry: Entry = _USED) -> dict[str, Entry]:
    return {path: entry} | {f"{path}@{name}": use for name, use in attributes.items()}


def _root() -> dict[str, Entry]:
    table: dict[str, Entry] = {"@fmiVersion": ("used", "2.0 or 3.0"), "@guid": _USED, "@instantiationToken": _USED}
    table |= {f"@{name}": _PEOPLE for name in _ABOUT.split()} | {"@numberOfEventIndicators": _TOOLS}
    for kind in ("CoSimulation", "ModelExchange", "ScheduledExecution"):
        table |= _below(kind, _INTERFACE) | {f"{kind}/SourceFiles/**": _TOOLS, f"{kind}/Annotations/**": _PEOPLE}
    table |= _below("DefaultExperiment", _EXPERIMENT)
    table |= {"ModelStructure/**": ("used", "states and derivatives for model exchange"), "LogCategories/**": _TOOLS}
    return table | {"VendorAnnotations/**": _PEOPLE, "Annotations/**": _PEOPLE}


def _units() -> dict[str, Entry]:
    powers = dict.fromkeys(["kg", "m", "s", "A", "K", "mol", "cd", "rad", "factor", "offset"], _USED)
    table = _below("UnitDefinitions", {}) | _below("UnitDefinitions/Unit", {"name": _USED})
    table |= _below("UnitDefinitions/Unit/BaseUnit", powers)
    return table | {"UnitDefinitions/Unit/DisplayUnit/**": _PEOPLE, "UnitDefinitions/Unit/Annotations/**": _PEOPLE}


def _types() -> dict[str, Entry]:
    named: dict[str, Entry] = {"name": _USED, "description": _PEOPLE}
    item = named | {"value": ("used", "an enumeration accepts only the values or names of its items")}
    clock = dict.fromkeys((*_CLOCK.split(), "mimeType", "maxSize"), _TOOLS)
    table = _below("TypeDefinitions", {}) | _below("TypeDefinitions/SimpleType", named)
    table |= _below(f"TypeDefinitions/SimpleType/{KIND}", _QUANTITY)
    table |= _below(f"TypeDefinitions/SimpleType/{KIND}/Item", item)
    table |= _below(f"TypeDefinitions/{KIND}Type", named | _QUANTITY | clock)
    table |= _below(f"TypeDefinitions/{KIND}Type/Item", item)
    return table | {f"TypeDefinitions/{kind}/Annotations/**": _PEOPLE for kind in ("SimpleType", f"{KIND}Type")}


def _variables() -> dict[str, Entry]:
    clock = dict.fromkeys(_CLOCK.split(), _TOOLS)
    two, three = f"ModelVariables/ScalarVariable/{KIND}", f"ModelVariables/{KIND}"
    table = _below("ModelVariables", {}) | _below("ModelVariables/ScalarVariable", _VARIABLE)
    table |= _below(two, _QUANTITY | _VARIABLE) | {"ModelVariables/ScalarVariable/Annotations/**": _PEOPLE}
    table |= _below(three, _QUANTITY | _VARIABLE | clock) | {f"{three}/Annotations/**": _PEOPLE}
    table |= _below(f"{three}/Dimension", {"start": _USED, "valueReference": _USED})
    table |= _below(f"{three}/Start", {"value": _USED})
    return table | _below(f"{three}/Alias", {"name": _USED, "description": _PEOPLE, "displayUnit": _PEOPLE})


FMI = FileFormat(
    "modelDescription.xml",
    "Functional Mock-up Interface 2.0 and 3.0; KIND is Real or Float64, Integer, and so on",
    _root() | _units() | _types() | _variables(),
)
_NOTHING = {"DefaultExperiment@startTime": ("0", "0.0"), "clocks": ("",)}
#: Where a tag is a kind, and what the table calls it.
_PLACES = {
    "ModelVariables": dict.fromkeys(KINDS3, KIND),
    "ModelVariables/ScalarVariable": dict.fromkeys(KINDS2, KIND),
    "TypeDefinitions/SimpleType": dict.fromkeys(KINDS2, KIND),
    "TypeDefinitions": {f"{kind}Type": f"{KIND}Type" for kind in KINDS3},
}


def names(description: bytes) -> Iterator[str]:
    """Yield the names in a description, as the table writes them; names without information are left out.

    Raises
    ------
    xml.etree.ElementTree.ParseError
        The description is not XML.
    """
    root = ElementTree.fromstring(description)
    yield from (f"@{key}" for key in root.attrib if not key.startswith("{"))
    stack = [(child, child.tag) for child in root]
    while stack:
        element, path = stack.pop()
        yield path
        if f"{path}/**" in FMI.table:
            continue
        for key, value in element.attrib.items():
            name = f"{path}@{key}"
            if value not in _NOTHING.get(name, _NOTHING.get(key, ())) and not key.startswith("{"):
                yield name
        tags = _PLACES.get(path, {})
        stack += [(child, f"{path}/{tags.get(child.tag, child.tag)}") for child in element]


def attributes(description: bytes) -> dict[str, dict[str, str]]:
    """Return the unchanged attributes of each variable's own type, by the variable's name.

    FMPy 0.3 does not read `relativeQuantity` of a variable, nor the bounds of unsigned ones.
    """
    result = ElementTree.fromstring(description).find("ModelVariables")
    return {
        str(variable.get("name")): dict(variable[0].attrib if variable.tag == "ScalarVariable" else variable.attrib)
        for variable in (result if result is not None else ())
        if variable.tag != "ScalarVariable" or len(variable)
    }
