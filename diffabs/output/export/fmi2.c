/* FMI 2.0 for co-simulation of a plant. The text before this file defines the struct `model`, plant_start, plant_step,
   plant_show, GUID, VARIABLES, OUTPUTS, INPUTS, STATES and STEP. It also defines arrays for the variables: `begun`
   (values before anything is set) and `low` and `high` (limits). A call out of order or with a value out of range returns an
   error and changes nothing. After a failed step only a reset, another state or termination is allowed. */
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef void *fmi2Component;
typedef const char *fmi2String;
typedef unsigned int fmi2ValueReference;
typedef int fmi2Boolean;
typedef char fmi2Byte;

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

enum { INSTANTIATED, INITIALISING, RUNNING, FAILED, TERMINATED };

static bool in(const model *m, int phase) { return m != NULL && m->phase == phase; }

static void begin(model *m)
{
  memset(m, 0, sizeof *m);
  memcpy(m->v, begun, sizeof begun);
  memcpy(m->guid, GUID, sizeof m->guid);
}

EXPORT fmi2Component fmi2Instantiate(fmi2String name, int type, fmi2String guid, fmi2String place, const void *functions,
                                     fmi2Boolean visible, fmi2Boolean logging)
{
  model *m;
  (void)name, (void)place, (void)functions, (void)visible, (void)logging;
  if (type != 1 || guid == NULL || strcmp(guid, GUID) != 0)
    return NULL;
  m = malloc(sizeof *m);
  if (m != NULL)
    begin(m);
  return m;
}

EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }

EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
  (void)c, (void)on, (void)n, (void)categories;
  return fmi2OK;
}

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerant, double tolerance, double start,
                                      fmi2Boolean stops, double stop)
{
  model *m = c;
  (void)tolerant, (void)tolerance;
  if (!in(m, INSTANTIATED) || !isfinite(start) || (stops && !(stop >= start)))
    return fmi2Error;
  m->time = start;
  m->stop = stops ? stop : (double)INFINITY;
  m->ready = 1;
  return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
  model *m = c;
  if (!in(m, INSTANTIATED) || !m->ready)
    return fmi2Error;
  m->phase = INITIALISING;
  return fmi2OK;
}

EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
  model *m = c;
  if (!in(m, INITIALISING))
    return fmi2Error;
  plant_start(m);
  plant_show(m);
  m->phase = RUNNING;
  return fmi2OK;
}

EXPORT fmi2Status fmi2Terminate(fmi2Component c)
{
  model *m = c;
  if (!in(m, RUNNING))
    return fmi2Error;
  m->phase = TERMINATED;
  return fmi2OK;
}

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
  if (c == NULL)
    return fmi2Error;
  begin(c);
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference at[], size_t n, double value[])
{
  model *m = c;
  if (m == NULL || (n > 0 && (at == NULL || value == NULL)))
    return fmi2Error;
  for (size_t i = 0; i < n; i++)
    if (at[i] >= VARIABLES)
      return fmi2Error;
  if (m->phase < RUNNING) { /* before the start, outputs follow from the parameters set so far */
    plant_start(m);
    plant_show(m);
  }
  for (size_t i = 0; i < n; i++)
    value[i] = m->v[at[i]];
  return fmi2OK;
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference at[], size_t n, const double value[])
{
  model *m = c;
  if (m == NULL || m->phase > RUNNING || (n > 0 && (at == NULL || value == NULL)))
    return fmi2Error;
  for (size_t i = 0; i < n; i++)
    if (at[i] >= VARIABLES || at[i] < OUTPUTS || (m->phase == RUNNING && at[i] >= OUTPUTS + INPUTS) ||
        !(value[i] >= low[at[i]] && value[i] <= high[at[i]]))
      return fmi2Error; /* only the controls are inputs; parameters are fixed after initialization */
  for (size_t i = 0; i < n; i++)
    m->v[at[i]] = value[i];
  return fmi2OK;
}

EXPORT fmi2Status fmi2DoStep(fmi2Component c, double from, double length, fmi2Boolean no_return)
{
  model *m = c;
  const double whole = length / STEP, nearest = floor(whole + 0.5);
  const double count = fabs(whole - nearest) <= 1e-6 * nearest ? nearest : ceil(whole);
  (void)no_return;
  if (!in(m, RUNNING) || !isfinite(from) || !(length > 0) || !(count < 1e9))
    return fmi2Error;
  /* FMI 2.0, section 2.1.6: a step past the stop time is an error. Importers add up times, so rounding is no such step. */
  if (isfinite(m->stop) && from + length > m->stop + 1e-9 * (fabs(m->stop) + length))
    return fmi2Error;
  for (long i = 0; i < (long)count; i++) {
    const double h = length / count;
    plant_step(m, from + (double)i * h, h);
  }
  m->time = from + length;
  plant_show(m);
  for (size_t i = 0; i < STATES; i++)
    if (!isfinite(m->x[i])) {
      m->phase = FAILED;
      return fmi2Error;
    }
  return fmi2OK;
}

/* The GUID in a state guards against a state of another model, whose numbers mean something else. */
static fmi2Status copied(model *to, const model *from)
{
  if (to == NULL || from == NULL || strcmp(from->guid, GUID) != 0)
    return fmi2Error;
  memcpy(to, from, sizeof *to);
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, void **state)
{
  if (c == NULL || state == NULL)
    return fmi2Error;
  if (*state == NULL)
    *state = malloc(sizeof(model));
  return copied(*state, c);
}

EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, void *state) { return copied(c, state); }

EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, void **state)
{
  if (c == NULL || state == NULL)
    return fmi2Error;
  free(*state);
  *state = NULL;
  return fmi2OK;
}

EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, void *state, size_t *size)
{
  if (c == NULL || state == NULL || size == NULL)
    return fmi2Error;
  *size = sizeof(model);
  return fmi2OK;
}

EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, void *state, fmi2Byte bytes[], size_t size)
{
  if (c == NULL || state == NULL || bytes == NULL || size < sizeof(model))
    return fmi2Error;
  memcpy(bytes, state, sizeof(model));
  return fmi2OK;
}

EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, void **state)
{
  model read;
  if (c == NULL || bytes == NULL || state == NULL || size != sizeof read)
    return fmi2Error;
  memcpy(&read, bytes, sizeof read);
  if (strncmp(read.guid, GUID, sizeof read.guid) != 0 || read.phase < INSTANTIATED || read.phase > TERMINATED)
    return fmi2Error;
  if (*state == NULL)
    *state = malloc(sizeof(model));
  return copied(*state, &read);
}

/* Functions that FMI demands for types that this FMU has no variables of. */
#define NONE(kind, type)                                                                                               \
  EXPORT fmi2Status fmi2Get##kind(fmi2Component c, const fmi2ValueReference at[], size_t n, type value[])              \
  {                                                                                                                    \
    (void)c, (void)at, (void)value;                                                                                    \
    return n == 0 ? fmi2OK : fmi2Error;                                                                                \
  }                                                                                                                    \
  EXPORT fmi2Status fmi2Set##kind(fmi2Component c, const fmi2ValueReference at[], size_t n, const type value[])        \
  {                                                                                                                    \
    (void)c, (void)at, (void)value;                                                                                    \
    return n == 0 ? fmi2OK : fmi2Error;                                                                                \
  }
NONE(Integer, int)
NONE(Boolean, fmi2Boolean)
NONE(String, fmi2String)

EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n,
                                               const fmi2ValueReference known[], size_t k, const double by[],
                                               double value[])
{
  (void)c, (void)unknown, (void)n, (void)known, (void)k, (void)by, (void)value;
  return fmi2Error;
}

#define NO_DERIVATIVES(name, type)                                                                                     \
  EXPORT fmi2Status name(fmi2Component c, const fmi2ValueReference at[], size_t n, const int order[], type value[])    \
  {                                                                                                                    \
    (void)c, (void)at, (void)n, (void)order, (void)value;                                                              \
    return fmi2Error;                                                                                                  \
  }
NO_DERIVATIVES(fmi2SetRealInputDerivatives, const double)
NO_DERIVATIVES(fmi2GetRealOutputDerivatives, double)

EXPORT fmi2Status fmi2CancelStep(fmi2Component c)
{
  (void)c;
  return fmi2Error;
}

#define NO_STATUS(name, type)                                                                                          \
  EXPORT fmi2Status fmi2Get##name(fmi2Component c, int kind, type *value)                                              \
  {                                                                                                                    \
    (void)c, (void)kind, (void)value;                                                                                  \
    return fmi2Discard;                                                                                                \
  }
NO_STATUS(Status, fmi2Status)
NO_STATUS(IntegerStatus, int)
NO_STATUS(BooleanStatus, fmi2Boolean)
NO_STATUS(StringStatus, fmi2String)

EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, int kind, double *value)
{
  if (c == NULL || value == NULL)
    return fmi2Error;
  if (kind != 2) /* fmi2LastSuccessfulTime */
    return fmi2Discard;
  *value = ((model *)c)->time;
  return fmi2OK;
}
