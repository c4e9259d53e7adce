"""The functions of FMI 3.0, Co-Simulation, around an exported model: C99 without headers of others.

Modelica Association, Functional Mock-up Interface Specification 3.0, 2022, Sec. 2 and 4. A model has numbers alone; of
all other types there are none, and who asks for one gets fmi3Error.
"""

import re

from hhtjax.export.model import FLAGS

PLATFORM = """/* {name}, {token}: functions of FMI 3.0 (Co-Simulation); see {name}.h for the model itself */

#include "{name}.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define API __declspec(dllexport)
#elif defined __GNUC__
#define API __attribute__((visibility("default")))
#else
#define API
#endif

typedef void *fmi3Instance;
typedef unsigned int Reference;
typedef enum {{ OK, Warning, Discard, Error, Fatal }} fmi3Status;
typedef void (*Logger)(void *environment, fmi3Status status, const char *category, const char *message);

enum {{ {ranges} }};

typedef struct {{
    {name}_state s;
    {name}_params p;
    {name}_real start[{num_starts} + 1];
    {name}_real u[{num_inputs} + 1];
    double t0;
    bool runs;
}} Model;

typedef struct {{
    Model m;
    Logger log;
    void *environment;
}} Instance;

static const {name}_real starts[] = {{{starts}}};
static const {name}_real inputs[] = {{{inputs}}};

static fmi3Status fails(Instance *i, const char *message)
{{
    if (i->log != NULL) {{
        i->log(i->environment, Error, "logStatusError", message);
    }}
    return Error;
}}

static {name}_real *place(Model *m, const Reference r)
{{
    switch (r) {{
{places}
    default: return NULL;
    }}
}}

static void reset(Model *m)
{{
    memset(m, 0, sizeof *m);
    m->p = {name}_defaults;
    memcpy(m->start, starts, {num_starts} * sizeof *starts);
    memcpy(m->u, inputs, {num_inputs} * sizeof *inputs);
}}

static int begin(Model *m)
{{
    return {name}_init(&m->s, &m->p, {arguments}({name}_real)m->t0, ({name}_real){dt});
}}

static fmi3Status verdict(Instance *i)
{{
    const int flags = i->m.s.flags;
    if (flags == 0) {{
        return OK;
    }}
    return fails(i, {verdict});
}}
"""

FUNCTIONS = """
API const char *fmi3GetVersion(void) { return "3.0"; }

API fmi3Status fmi3SetDebugLogging(fmi3Instance i, bool on, size_t n, const char *const categories[])
{
    (void)i, (void)on, (void)n, (void)categories;
    return OK;
}

API fmi3Instance fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging, bool events, bool early,
    const Reference *intermediate, size_t n, void *environment, Logger log, void (*update)(void))
{
    Instance *i = NULL;
    (void)name, (void)resources, (void)visible, (void)logging, (void)early, (void)intermediate, (void)update;
    if (token != NULL && strcmp(token, TOKEN) == 0 && !events && n == 0) {
        i = calloc(1, sizeof *i);
    }
    if (i != NULL) {
        i->log = log;
        i->environment = environment;
        reset(&i->m);
    } else if (log != NULL) {
        log(environment, Error, "logStatusError", "no instance: another token, event mode, or no memory");
    }
    return i;
}

API void fmi3FreeInstance(fmi3Instance i) { free(i); }

API fmi3Status fmi3EnterInitializationMode(
    fmi3Instance i, bool defined, double tolerance, double start, bool stops, double stop)
{
    Instance *const x = i;
    (void)defined, (void)tolerance, (void)stops, (void)stop;
    x->m.t0 = start;
    return OK;
}

API fmi3Status fmi3ExitInitializationMode(fmi3Instance i)
{
    Instance *const x = i;
    (void)begin(&x->m);
    x->m.runs = true;
    return verdict(x);
}

API fmi3Status fmi3Terminate(fmi3Instance i)
{
    (void)i;
    return OK;
}

API fmi3Status fmi3Reset(fmi3Instance i)
{
    reset(&((Instance *)i)->m);
    return OK;
}

API fmi3Status fmi3Get@(fmi3Instance i, const Reference r[], size_t n, #_real values[], size_t num_values)
{
    Instance *const x = i;
    size_t k;
    bool computed = false;
    for (k = 0; k < n; k++) {
        const #_real *const value = place(&x->m, r[k]);
        if (value == NULL || k >= num_values) {
            return fails(x, "there is no such variable");
        }
        if (r[k] < FIRST_START && !x->m.runs && !computed) {
            (void)begin(&x->m);
            computed = true;
        }
        values[k] = *value;
    }
    return OK;
}

API fmi3Status fmi3Set@(fmi3Instance i, const Reference r[], size_t n, const #_real values[], size_t num_values)
{
    Instance *const x = i;
    size_t k;
    for (k = 0; k < n; k++) {
        #_real *const value = place(&x->m, r[k]);
        if (value == NULL || k >= num_values || r[k] < FIRST_START || (r[k] < FIRST_PARAM && x->m.runs)) {
            return fails(x, "there is no such variable, or it cannot be set, or not now");
        }
        *value = values[k];
    }
    return OK;
}

API fmi3Status fmi3DoStep(fmi3Instance i, double t, double h, bool no_return, bool *event, bool *ends, bool *early,
                          double *last)
{
    Instance *const x = i;
    const double ratio = h / DT, whole = floor(ratio + 0.5);
    const bool fits = whole >= 1 && fabs(ratio - whole) <= 1e-9 * whole;
    const double count = fits ? whole : ceil(ratio);
    const #_real dt = (#_real)(fits ? DT : h / count);
    double k;
    (void)t, (void)no_return;
    *event = false, *ends = false, *early = false;
    if (!x->m.runs || !(h > 0)) {
        return fails(x, "a step needs a model that is initialised, and a positive size");
    }
    for (k = 0; k < count && x->m.s.flags == 0; k += 1) {
        (void)#_step(&x->m.s, &x->m.p, x->m.u, dt);
    }
    *last = (double)x->m.s.t;
    return verdict(x);
}

API fmi3Status fmi3GetFMUState(fmi3Instance i, void **state)
{
    if (*state == NULL) {
        *state = malloc(sizeof(Model));
    }
    if (*state == NULL) {
        return fails(i, "no memory");
    }
    memcpy(*state, &((Instance *)i)->m, sizeof(Model));
    return OK;
}

API fmi3Status fmi3SetFMUState(fmi3Instance i, void *state)
{
    memcpy(&((Instance *)i)->m, state, sizeof(Model));
    return OK;
}

API fmi3Status fmi3FreeFMUState(fmi3Instance i, void **state)
{
    (void)i;
    free(*state);
    *state = NULL;
    return OK;
}

API fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, void *state, size_t *size)
{
    (void)i, (void)state;
    *size = sizeof(Model);
    return OK;
}

API fmi3Status fmi3SerializeFMUState(fmi3Instance i, void *state, unsigned char bytes[], size_t size)
{
    if (size != sizeof(Model)) {
        return fails(i, "a state of another size");
    }
    memcpy(bytes, state, size);
    return OK;
}

API fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const unsigned char bytes[], size_t size, void **state)
{
    if (size != sizeof(Model)) {
        return fails(i, "a state of another size");
    }
    if (*state == NULL) {
        *state = malloc(size);
    }
    if (*state == NULL) {
        return fails(i, "no memory");
    }
    memcpy(*state, bytes, size);
    return OK;
}
"""


def wrapper(name, kind, token, **parts):
    """The text of fmi3.c. kind: Float64 or Float32; parts: what PLATFORM names besides."""
    *flags, (_, last) = FLAGS.items()
    verdict = "".join(f'(flags & {name.upper()}_{flag}) ? "{text}"\n        : ' for flag, text in flags)
    text = PLATFORM.format(name=name, token=token, verdict=f'{verdict}"{last}"', **parts)
    text += f'\n#define TOKEN "{token}"\n#define DT {parts["dt"]}\n'
    text += FUNCTIONS.replace("@", kind).replace("#_", f"{name}_")
    return text + absent("Float32" if kind == "Float64" else "Float64")


# ----------------------------------------------------------------------------
# Functions of FMI 3.0 that have to be there, and that a model of numbers and fixed steps answers with fmi3Error.
#
# Where values of some type are asked for, and none is meant, all is well.


SOME, VALUES = "const Reference r[], size_t n", "const Reference r[], size_t n, const void *x, size_t m"
NONE, NO_VALUES, NEVER = "n == 0", "n == 0 && m == 0", "false"
BINARY = "const Reference r[], size_t n, const size_t s[], const void *x, size_t m"
DERIVATIVES = (
    "const Reference y[], size_t n, const Reference x[], size_t m, const double s[], size_t k, double d[], size_t l"
)
TYPES = "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Boolean", "String"
ABSENT = {  # arguments behind the instance, when they ask for nothing
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
    found = {f"{way}{kind}": (VALUES, NO_VALUES) for way in ("Get", "Set") for kind in (*TYPES, other)} | ABSENT
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
