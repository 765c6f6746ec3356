/* The functions of FMI 2.0 for co-simulation. */

#include "fmi2Functions.h"

#include "instance.h"
#include "log.h"
#include "simulation.h"
#include "state.h"
#include "values.h"

typedef struct {
    Instance instance;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
} Component;

const char model_token[] = TOKEN_FMI2;

void emit_message(const Instance *instance, Status status, const char *category,
                  const char *message) {
    const Component *component = (const Component *)instance;
    if (component->logger != NULL) {
        component->logger(component->environment, instance->name, (fmi2Status)status, category,
                          message);
    }
}

const char *fmi2GetTypesPlatform(void) {
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void) {
    return "2.0";
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t number,
                               const fmi2String categories[]) {
    return (fmi2Status)set_logging(c, __func__, on, number, categories);
}

/* Creation and destruction */

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String,
                              const fmi2CallbackFunctions *functions, fmi2Boolean, fmi2Boolean) {
    Instance *instance = instance_create(sizeof(Component), name);

    if (instance == NULL) {
        return NULL;
    }
    if (functions != NULL) {
        ((Component *)instance)->logger = functions->logger;
        ((Component *)instance)->environment = functions->componentEnvironment;
    }
    if (!accepts(instance, __func__, guid)) {
        instance_free(instance);
        return NULL;
    }
    if (type != fmi2CoSimulation) {
        report(instance, STATUS_ERROR, __func__, "the FMU is for co-simulation only");
        instance_free(instance);
        return NULL;
    }
    return instance;
}

void fmi2FreeInstance(fmi2Component c) {
    instance_free(c);
}

/* Initialization, termination and reset */

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean, fmi2Real, fmi2Real start_time,
                               fmi2Boolean stop_time_defined, fmi2Real stop_time) {
    return (fmi2Status)set_up_experiment(c, __func__, start_time, stop_time_defined, stop_time);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    return (fmi2Status)enter_initialization(c, __func__);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    return (fmi2Status)exit_initialization(c, __func__);
}

fmi2Status fmi2Terminate(fmi2Component c) {
    return (fmi2Status)terminate(c, __func__);
}

fmi2Status fmi2Reset(fmi2Component c) {
    return (fmi2Status)reset(c, __func__);
}

/* Variables */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference references[], size_t number,
                       fmi2Real values[]) {
    return (fmi2Status)get_reals(c, __func__, references, number, values);
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference references[], size_t number,
                          fmi2Integer values[]) {
    return (fmi2Status)get_enumerations(c, __func__, references, number, values);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference[], size_t number,
                          fmi2Boolean[]) {
    return (fmi2Status)no_such_variables(c, __func__, number);
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference[], size_t number, fmi2String[]) {
    return (fmi2Status)no_such_variables(c, __func__, number);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference references[], size_t number,
                       const fmi2Real values[]) {
    return (fmi2Status)set_reals(c, __func__, references, number, values);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference references[], size_t number,
                          const fmi2Integer values[]) {
    return (fmi2Status)set_enumerations(c, __func__, references, number, values);
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference[], size_t number,
                          const fmi2Boolean[]) {
    return (fmi2Status)no_such_variables(c, __func__, number);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference[], size_t number,
                         const fmi2String[]) {
    return (fmi2Status)no_such_variables(c, __func__, number);
}

/* FMU states */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    return (fmi2Status)get_state(c, __func__, state);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    return (fmi2Status)set_state(c, __func__, state);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    return (fmi2Status)free_state(c, __func__, state);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate, size_t *size) {
    return (fmi2Status)serialized_size(c, __func__, size);
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[],
                                 size_t size) {
    return (fmi2Status)serialize_state(c, __func__, state, bytes, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state) {
    return (fmi2Status)deserialize_state(c, __func__, bytes, size, state);
}

/* Partial derivatives */

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                        size_t number_of_unknowns,
                                        const fmi2ValueReference knowns[], size_t number_of_knowns,
                                        const fmi2Real seed[], fmi2Real sensitivity[]) {
    return (fmi2Status)directional_derivative(c, __func__, unknowns, number_of_unknowns, knowns,
                                              number_of_knowns, seed, sensitivity);
}

/* Co-simulation */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference[], size_t,
                                       const fmi2Integer[], const fmi2Real[]) {
    return (fmi2Status)not_supported(c, __func__);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference[], size_t,
                                        const fmi2Integer[], fmi2Real[]) {
    return (fmi2Status)not_supported(c, __func__);
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean) {
    return (fmi2Status)do_step(c, __func__, time, step);
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    return (fmi2Status)not_supported(c, __func__);
}

/* Status. Steps are never pending, so only the outcome of the last one can be queried. */

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    const Instance *instance = c;
    if (instance == NULL || kind != fmi2DoStepStatus) {
        return (fmi2Status)no_such_status(instance, __func__);
    }
    *value = (fmi2Status)instance->simulation.step_status;
    return fmi2OK;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    const Instance *instance = c;
    if (instance == NULL || kind != fmi2LastSuccessfulTime) {
        return (fmi2Status)no_such_status(instance, __func__);
    }
    *value = instance->simulation.reals.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind, fmi2Integer *) {
    return (fmi2Status)no_such_status(c, __func__);
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    if (c == NULL || kind != fmi2Terminated) {
        return (fmi2Status)no_such_status(c, __func__);
    }
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
    if (c == NULL || kind != fmi2PendingStatus) {
        return (fmi2Status)no_such_status(c, __func__);
    }
    *value = "";
    return fmi2OK;
}
