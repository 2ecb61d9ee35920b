/* A van der Pol oscillator, x'' = 2 (1 - x^2) x' - x + u, as an FMU: Runge-Kutta steps. */
#include <stdlib.h>
#include <string.h>
#include "fmi2FunctionTypes.h"

typedef struct { double x, v, u; } Model;

static void rate(const Model *m, double x, double v, double *dx, double *dv) {
    *dx = v;
    *dv = 2 * (1 - x * x) * v - x + m->u;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean b) {
    Model *m = c;
    int k, n = (int)(h / 0.001) + 1;
    for (k = 0, h /= n; k < n; k++) {
        double a[4], d[4];
        rate(m, m->x, m->v, &a[0], &d[0]);
        rate(m, m->x + h / 2 * a[0], m->v + h / 2 * d[0], &a[1], &d[1]);
        rate(m, m->x + h / 2 * a[1], m->v + h / 2 * d[1], &a[2], &d[2]);
        rate(m, m->x + h * a[2], m->v + h * d[2], &a[3], &d[3]);
        m->x += h / 6 * (a[0] + 2 * a[1] + 2 * a[2] + a[3]);
        m->v += h / 6 * (d[0] + 2 * d[1] + 2 * d[2] + d[3]);
    }
    return fmi2OK;
}
static double *at(fmi2Component c, fmi2ValueReference r) { return (double *)c + r; }
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real x[]) {
    while (n--) x[n] = *at(c, r[n]);
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real x[]) {
    while (n--) *at(c, r[n]) = x[n];
    return fmi2OK;
}
fmi2Status fmi2Reset(fmi2Component c) {
    Model start = {0.1, 0, 0};
    *(Model *)c = start;
    return fmi2OK;
}
fmi2Component fmi2Instantiate(fmi2String a, fmi2Type b, fmi2String g, fmi2String d,
                              const fmi2CallbackFunctions *f, fmi2Boolean v, fmi2Boolean l) {
    fmi2Component c = malloc(sizeof(Model));
    fmi2Reset(c);
    return c;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real d, fmi2Boolean e, fmi2Real f) { return fmi2OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) {
    *s = malloc(sizeof(Model));
    memcpy(*s, c, sizeof(Model));
    return fmi2OK;
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) { memcpy(c, s, sizeof(Model)); return fmi2OK; }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) { free(*s); *s = NULL; return fmi2OK; }
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate s, size_t *n) { *n = sizeof(Model); return fmi2OK; }
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n) { memcpy(b, s, n); return fmi2OK; }
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte b[], size_t n, fmi2FMUstate *s) {
    if (!*s) *s = malloc(n);
    memcpy(*s, b, n);
    return fmi2OK;
}

/* Others must exist, and are never called. */
#define OTHER(name) int name(void) { return fmi2Error; }
OTHER(fmi2GetTypesPlatform) OTHER(fmi2GetVersion) OTHER(fmi2SetDebugLogging)
OTHER(fmi2GetInteger) OTHER(fmi2GetBoolean) OTHER(fmi2GetString)
OTHER(fmi2SetInteger) OTHER(fmi2SetBoolean) OTHER(fmi2SetString)
OTHER(fmi2GetDirectionalDerivative) OTHER(fmi2SetRealInputDerivatives) OTHER(fmi2GetRealOutputDerivatives)
OTHER(fmi2CancelStep) OTHER(fmi2GetStatus) OTHER(fmi2GetRealStatus)
OTHER(fmi2GetIntegerStatus) OTHER(fmi2GetBooleanStatus) OTHER(fmi2GetStringStatus)
