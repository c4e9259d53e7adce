"""Functions of FMI 3.0 that have to be there, and that a model of numbers and fixed steps answers with fmi3Error.

Where values of some type are asked for, and none is meant, all is well.
"""

import re

SOME, VALUES = "const Reference r[], size_t n", "const Reference r[], size_t n, const void *x, size_t m"
NONE, NO_VALUES, NEVER = "n == 0", "n == 0 && m == 0", "false"
BINARY = "const Reference r[], size_t n, const size_t s[], const void *x, size_t m"
DERIVATIVES = (
    "const Reference y[], size_t n, const Reference x[], size_t m, const double s[], size_t k, double d[], size_t l"
)
TYPES = "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Boolean", "String"
FUNCTIONS = {  # arguments behind the instance, when they ask for nothing
    **dict.fromkeys(("GetBinary", "SetBinary"), (BINARY, NO_VALUES)),
    **dict.fromkeys(("GetClock", "SetClock"), (f"{SOME}, const void *x", NONE)),
    **dict.fromkeys(("GetShiftDecimal", "SetShiftDecimal", "SetIntervalDecimal"), (f"{SOME}, const void *x", NONE)),
    "GetIntervalDecimal": (f"{SOME}, double x[], int q[]", NONE),
    **dict.fromkeys(
        ("GetShiftFraction", "SetShiftFraction", "SetIntervalFraction"), (f"{SOME}, const void *x, const void *y", NONE)
    ),
    "GetIntervalFraction": (f"{SOME}, const void *x, const void *y, int q[]", NONE),
    **dict.fromkeys(("GetDirectionalDerivative", "GetAdjointDerivative"), (DERIVATIVES, NEVER)),
    "GetOutputDerivatives": (f"{SOME}, const int32_t o[], double x[], size_t m", NO_VALUES),
    "GetNumberOfVariableDependencies": ("Reference r, size_t *n", NEVER),
    "GetVariableDependencies": ("Reference r, size_t e[], Reference x[], size_t f[], int k[], size_t n", NEVER),
    "UpdateDiscreteStates": ("bool *a, bool *b, bool *c, bool *d, bool *e, double *t", NEVER),
    **dict.fromkeys(("EnterConfigurationMode", "ExitConfigurationMode", "EvaluateDiscreteStates"), ("", NEVER)),
    **dict.fromkeys(("EnterEventMode", "EnterStepMode", "EnterContinuousTimeMode"), ("", NEVER)),
    "CompletedIntegratorStep": ("bool a, bool *b, bool *c", NEVER),
    "SetTime": ("double t", NEVER),
    "SetContinuousStates": ("const double x[], size_t n", NEVER),
    **dict.fromkeys(("GetContinuousStates", "GetContinuousStateDerivatives"), ("double x[], size_t n", NEVER)),
    **dict.fromkeys(("GetEventIndicators", "GetNominalsOfContinuousStates"), ("double x[], size_t n", NEVER)),
    **dict.fromkeys(("GetNumberOfEventIndicators", "GetNumberOfContinuousStates"), ("size_t *n", NEVER)),
    "ActivateModelPartition": ("Reference r, double t", NEVER),
}
INSTANCES = {
    "ModelExchange": "Logger g",
    "ScheduledExecution": "Logger g, void (*h)(void), void (*i)(void), void (*j)(void)",
}
FUNCTION = """
API fmi3Status fmi3{name}(fmi3Instance i{arguments})
{{
{unused}    return {fine} ? OK : fails(i, "not there: fmi3{name}");
}}
"""
INSTANCE = """
API fmi3Instance fmi3Instantiate{kind}(
    const char *a, const char *b, const char *c, bool d, bool e, void *f, {arguments})
{{
    (void)a, (void)b, (void)c, (void)d, (void)e, (void)f{unused};
    return NULL;
}}
"""


def absent(other):
    """Their text. other: the type of floating numbers that the model has not."""
    found = {f"{way}{kind}": (VALUES, NO_VALUES) for way in ("Get", "Set") for kind in (*TYPES, other)} | FUNCTIONS
    text = ""
    for name, (arguments, fine) in found.items():
        names = re.findall(r"(\w+)(?:\[\])?(?:,|$)", arguments)
        unused = f"    (void)i{''.join(f', (void){x}' for x in names)};\n"
        text += FUNCTION.format(name=name, arguments=f", {arguments}" * bool(arguments), unused=unused, fine=fine)
    for kind, arguments in INSTANCES.items():
        names = re.findall(r"Logger (\w)|\(\*(\w)\)", arguments)
        unused = "".join(f", (void){x or y}" for x, y in names)
        text += INSTANCE.format(kind=kind, arguments=arguments, unused=unused)
    return text
