/* The functions of FMI 2.0 for co-simulation. */

#include "fmi2Functions.h"

#define FMI(name) fmi2##name
#define OF_STATE(verb, noun) fmi2##verb##FMUstate##noun
#define DESERIALIZE fmi2DeSerializeFMUstate
#define AND_LENGTH
#define FITS true

#include "fmu_instance.h"

static void emit(const void *instance, const char *message) {
    const Controller *controller = instance;
    fmi2CallbackLogger logger;
    memcpy(&logger, &controller->logger, sizeof logger); /* ISO C has no cast between the two */
    logger(controller->environment, controller->name, fmi2Error, "logStatusError", message);
}

const char *fmi2GetTypesPlatform(void) {
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void) {
    return "2.0";
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[]) {
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String folder,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean on) {
    Controller *controller = type == fmi2CoSimulation ? create(name, token) : NULL;
    if (controller != NULL && functions != NULL && functions->logger != NULL) {
        memcpy(&controller->logger, &functions->logger, sizeof controller->logger);
        controller->environment = functions->componentEnvironment;
        controller->emit = emit;
    }
    return controller;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    Memory *memory = &((Controller *)c)->memory;
    memory->start = memory->time = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    ((Controller *)c)->memory.mode = INITIALIZATION;
    return fmi2OK;
}

ACCESS(Real, 'd')
ACCESS(Integer, 'i')
ACCESS(Boolean, '?')

/* Functions of types that no variable has, and of derivatives. */
OF_NONE(GetString, fmi2String values[])
OF_NONE(SetString, const fmi2String values[])
OF_NONE(SetRealInputDerivatives, const fmi2Integer orders[], const fmi2Real values[])
OF_NONE(GetRealOutputDerivatives, const fmi2Integer orders[], fmi2Real values[])

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                        size_t n, const fmi2ValueReference knowns[], size_t m,
                                        const fmi2Real seed[], fmi2Real sensitivity[]) {
    return fmi2Error;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real size, fmi2Boolean no_set_state) {
    return OR_ERROR(step(c, time, size));
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    return fmi2Error;
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    return fmi2Discard; /* steps are never pending */
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    if (kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = ((Controller *)c)->memory.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    if (kind != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
    return fmi2Discard;
}
