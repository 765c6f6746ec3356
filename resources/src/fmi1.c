/* The functions of FMI 1.0 for co-simulation. The model identifier is the prefix of each name. */

#include <stddef.h>
#include <stdlib.h>

#include "fmi1Functions.h"

#include "instance.h"
#include "log.h"
#include "simulation.h"
#include "values.h"

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#define PASTE(a, b) a##_##b
#define PREFIXED(prefix, name) PASTE(prefix, name)
#define NAME(name) PREFIXED(MODEL_IDENTIFIER, name)

typedef struct {
    Instance instance;
    fmi1CallbackLogger logger;
} Component;

EXPORT fmi1GetTypesPlatformTYPE NAME(fmiGetTypesPlatform);
EXPORT fmi1GetVersionTYPE NAME(fmiGetVersion);
EXPORT fmi1SetDebugLoggingTYPE NAME(fmiSetDebugLogging);
EXPORT fmi1InstantiateSlaveTYPE NAME(fmiInstantiateSlave);
EXPORT fmi1FreeSlaveInstanceTYPE NAME(fmiFreeSlaveInstance);
EXPORT fmi1InitializeSlaveTYPE NAME(fmiInitializeSlave);
EXPORT fmi1TerminateSlaveTYPE NAME(fmiTerminateSlave);
EXPORT fmi1ResetSlaveTYPE NAME(fmiResetSlave);
EXPORT fmi1GetRealTYPE NAME(fmiGetReal);
EXPORT fmi1GetIntegerTYPE NAME(fmiGetInteger);
EXPORT fmi1GetBooleanTYPE NAME(fmiGetBoolean);
EXPORT fmi1GetStringTYPE NAME(fmiGetString);
EXPORT fmi1SetRealTYPE NAME(fmiSetReal);
EXPORT fmi1SetIntegerTYPE NAME(fmiSetInteger);
EXPORT fmi1SetBooleanTYPE NAME(fmiSetBoolean);
EXPORT fmi1SetStringTYPE NAME(fmiSetString);
EXPORT fmi1SetRealInputDerivativesTYPE NAME(fmiSetRealInputDerivatives);
EXPORT fmi1GetRealOutputDerivativesTYPE NAME(fmiGetRealOutputDerivatives);
EXPORT fmi1DoStepTYPE NAME(fmiDoStep);
EXPORT fmi1CancelStepTYPE NAME(fmiCancelStep);
EXPORT fmi1GetStatusTYPE NAME(fmiGetStatus);
EXPORT fmi1GetRealStatusTYPE NAME(fmiGetRealStatus);
EXPORT fmi1GetIntegerStatusTYPE NAME(fmiGetIntegerStatus);
EXPORT fmi1GetBooleanStatusTYPE NAME(fmiGetBooleanStatus);
EXPORT fmi1GetStringStatusTYPE NAME(fmiGetStringStatus);

const char model_token[] = TOKEN_FMI1;

void emit_message(const Instance *instance, Status status, const char *category,
                  const char *message) {
    const Component *component = (const Component *)instance;
    if (component->logger != NULL) {
        component->logger((fmi1Component)instance, instance->name, (fmi1Status)status, category,
                          message);
    }
}

const char *NAME(fmiGetTypesPlatform)(void) {
    return "standard32";
}

const char *NAME(fmiGetVersion)(void) {
    return "1.0";
}

fmi1Status NAME(fmiSetDebugLogging)(fmi1Component c, fmi1Boolean on) {
    return (fmi1Status)set_logging(c, __func__, on, 0, NULL);
}

/* Creation and destruction */

fmi1Component NAME(fmiInstantiateSlave)(fmi1String name, fmi1String guid, fmi1String, fmi1String,
                                        fmi1Real, fmi1Boolean, fmi1Boolean,
                                        fmi1CallbackFunctions functions, fmi1Boolean) {
    Instance *instance = instance_create(sizeof(Component), name);

    if (instance == NULL) {
        return NULL;
    }
    ((Component *)instance)->logger = functions.logger;
    if (!accepts(instance, __func__, guid)) {
        instance_free(instance);
        return NULL;
    }
    return instance;
}

void NAME(fmiFreeSlaveInstance)(fmi1Component c) {
    instance_free(c);
}

/* Initialization, termination and reset */

/* FMI 1.0 initializes in one call. If the call fails, the instance returns to its earlier phase. */
fmi1Status NAME(fmiInitializeSlave)(fmi1Component c, fmi1Real start_time,
                                    fmi1Boolean stop_time_defined, fmi1Real stop_time) {
    Instance *instance = c;
    Status status = set_up_experiment(instance, __func__, start_time, stop_time_defined, stop_time);

    if (status == STATUS_OK) {
        status = enter_initialization(instance, __func__);
    }
    if (status == STATUS_OK) {
        status = exit_initialization(instance, __func__);
        if (status != STATUS_OK) {
            instance->simulation.phase = PHASE_INSTANTIATED;
        }
    }
    return (fmi1Status)status;
}

fmi1Status NAME(fmiTerminateSlave)(fmi1Component c) {
    return (fmi1Status)terminate(c, __func__);
}

fmi1Status NAME(fmiResetSlave)(fmi1Component c) {
    return (fmi1Status)reset(c, __func__);
}

/* Variables */

fmi1Status NAME(fmiGetReal)(fmi1Component c, const fmi1ValueReference references[], size_t number,
                            fmi1Real values[]) {
    return (fmi1Status)get_reals(c, __func__, references, number, values);
}

fmi1Status NAME(fmiGetInteger)(fmi1Component c, const fmi1ValueReference references[],
                               size_t number, fmi1Integer values[]) {
    return (fmi1Status)get_enumerations(c, __func__, references, number, values);
}

fmi1Status NAME(fmiGetBoolean)(fmi1Component c, const fmi1ValueReference[], size_t number,
                               fmi1Boolean[]) {
    return (fmi1Status)no_such_variables(c, __func__, number);
}

fmi1Status NAME(fmiGetString)(fmi1Component c, const fmi1ValueReference[], size_t number,
                              fmi1String[]) {
    return (fmi1Status)no_such_variables(c, __func__, number);
}

fmi1Status NAME(fmiSetReal)(fmi1Component c, const fmi1ValueReference references[], size_t number,
                            const fmi1Real values[]) {
    return (fmi1Status)set_reals(c, __func__, references, number, values);
}

fmi1Status NAME(fmiSetInteger)(fmi1Component c, const fmi1ValueReference references[],
                               size_t number, const fmi1Integer values[]) {
    return (fmi1Status)set_enumerations(c, __func__, references, number, values);
}

fmi1Status NAME(fmiSetBoolean)(fmi1Component c, const fmi1ValueReference[], size_t number,
                               const fmi1Boolean[]) {
    return (fmi1Status)no_such_variables(c, __func__, number);
}

fmi1Status NAME(fmiSetString)(fmi1Component c, const fmi1ValueReference[], size_t number,
                              const fmi1String[]) {
    return (fmi1Status)no_such_variables(c, __func__, number);
}

/* Co-simulation */

fmi1Status NAME(fmiSetRealInputDerivatives)(fmi1Component c, const fmi1ValueReference[], size_t,
                                            const fmi1Integer[], const fmi1Real[]) {
    return (fmi1Status)not_supported(c, __func__);
}

fmi1Status NAME(fmiGetRealOutputDerivatives)(fmi1Component c, const fmi1ValueReference[], size_t,
                                             const fmi1Integer[], fmi1Real[]) {
    return (fmi1Status)not_supported(c, __func__);
}

fmi1Status NAME(fmiDoStep)(fmi1Component c, fmi1Real time, fmi1Real step, fmi1Boolean) {
    return (fmi1Status)do_step(c, __func__, time, step);
}

fmi1Status NAME(fmiCancelStep)(fmi1Component c) {
    return (fmi1Status)not_supported(c, __func__);
}

/* Status. Steps are never pending, so only the outcome of the last one can be queried. */

fmi1Status NAME(fmiGetStatus)(fmi1Component c, const fmi1StatusKind kind, fmi1Status *value) {
    const Instance *instance = c;
    if (instance == NULL || kind != fmi1DoStepStatus) {
        return (fmi1Status)no_such_status(instance, __func__);
    }
    *value = (fmi1Status)instance->simulation.step_status;
    return fmi1OK;
}

fmi1Status NAME(fmiGetRealStatus)(fmi1Component c, const fmi1StatusKind kind, fmi1Real *value) {
    const Instance *instance = c;
    if (instance == NULL || kind != fmi1LastSuccessfulTime) {
        return (fmi1Status)no_such_status(instance, __func__);
    }
    *value = instance->simulation.reals.time;
    return fmi1OK;
}

fmi1Status NAME(fmiGetIntegerStatus)(fmi1Component c, const fmi1StatusKind, fmi1Integer *) {
    return (fmi1Status)no_such_status(c, __func__);
}

fmi1Status NAME(fmiGetBooleanStatus)(fmi1Component c, const fmi1StatusKind, fmi1Boolean *) {
    return (fmi1Status)no_such_status(c, __func__);
}

fmi1Status NAME(fmiGetStringStatus)(fmi1Component c, const fmi1StatusKind kind, fmi1String *value) {
    if (c == NULL || kind != fmi1PendingStatus) {
        return (fmi1Status)no_such_status(c, __func__);
    }
    *value = "";
    return fmi1OK;
}
