/* FMI 2.0 for co-simulation around a plant: the struct `model`, plant_start, plant_step and plant_show stand before this,
   with GUID, VARIABLES, STATES, STEP and `begun`, the values of the variables before anything is set. */
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

static void begin(model *m)
{
  memset(m, 0, sizeof *m);
  memcpy(m->v, begun, sizeof begun);
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
  (void)tolerant, (void)tolerance, (void)stops, (void)stop;
  ((model *)c)->time = start;
  return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
  (void)c;
  return fmi2OK;
}

EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
  plant_start(c);
  plant_show(c);
  ((model *)c)->running = true;
  return fmi2OK;
}

EXPORT fmi2Status fmi2Terminate(fmi2Component c)
{
  (void)c;
  return fmi2OK;
}

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
  begin(c);
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference at[], size_t n, double value[])
{
  model *m = c;
  for (size_t i = 0; i < n; i++)
    if (at[i] >= VARIABLES)
      return fmi2Error;
  if (!m->running) { /* what is shown before the start is that of the parameters set so far */
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
  for (size_t i = 0; i < n; i++)
    if (at[i] >= VARIABLES || at[i] < OUTPUTS || (m->running && at[i] != OUTPUTS))
      return fmi2Error; /* only the control is an input; parameters are fixed once it runs */
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
  if (!m->running || !(length > 0) || !(count < 1e9))
    return fmi2Error;
  for (long i = 0; i < (long)count; i++) {
    const double h = length / count;
    plant_step(m, from + (double)i * h, h);
  }
  m->time = from + length;
  plant_show(m);
  for (size_t i = 0; i < STATES; i++)
    if (!isfinite(m->x[i]))
      return fmi2Error;
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, void **state)
{
  if (*state == NULL)
    *state = malloc(sizeof(model));
  if (*state == NULL)
    return fmi2Error;
  memcpy(*state, c, sizeof(model));
  return fmi2OK;
}

EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, void *state)
{
  memcpy(c, state, sizeof(model));
  return fmi2OK;
}

EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, void **state)
{
  (void)c;
  free(*state);
  *state = NULL;
  return fmi2OK;
}

EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, void *state, size_t *size)
{
  (void)c, (void)state;
  *size = sizeof(model);
  return fmi2OK;
}

EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, void *state, fmi2Byte bytes[], size_t size)
{
  (void)c;
  if (size < sizeof(model))
    return fmi2Error;
  memcpy(bytes, state, sizeof(model));
  return fmi2OK;
}

EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, void **state)
{
  (void)c;
  if (size != sizeof(model))
    return fmi2Error;
  if (*state == NULL)
    *state = malloc(sizeof(model));
  if (*state == NULL)
    return fmi2Error;
  memcpy(*state, bytes, sizeof(model));
  return fmi2OK;
}

/* What FMI asks every FMU to have, and this one has nothing of. */
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

EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference at[], size_t n,
                                              const int order[], const double value[])
{
  (void)c, (void)at, (void)n, (void)order, (void)value;
  return fmi2Error;
}

EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference at[], size_t n,
                                               const int order[], double value[])
{
  (void)c, (void)at, (void)n, (void)order, (void)value;
  return fmi2Error;
}

EXPORT fmi2Status fmi2CancelStep(fmi2Component c)
{
  (void)c;
  return fmi2Error;
}

EXPORT fmi2Status fmi2GetStatus(fmi2Component c, int kind, fmi2Status *value)
{
  (void)c, (void)kind, (void)value;
  return fmi2Discard;
}

EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, int kind, double *value)
{
  if (kind != 2) /* the last time that was reached */
    return fmi2Discard;
  *value = ((model *)c)->time;
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, int kind, int *value)
{
  (void)c, (void)kind, (void)value;
  return fmi2Discard;
}

EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, int kind, fmi2Boolean *value)
{
  (void)c, (void)kind, (void)value;
  return fmi2Discard;
}

EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, int kind, fmi2String *value)
{
  (void)c, (void)kind, (void)value;
  return fmi2Discard;
}
