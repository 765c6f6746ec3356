/* The functions of FMI 3.0 for co-simulation. Functions for other interface types, for clocks and
 * for undeclared capabilities only report that they are not supported. */

#include "fmi3Functions.h"

#include "instance.h"
#include "log.h"
#include "simulation.h"
#include "state.h"
#include "values.h"

typedef struct {
    Instance instance;
    fmi3LogMessageCallback logger;
    fmi3InstanceEnvironment environment;
} Component;

const char model_token[] = TOKEN_FMI3;

void emit_message(const Instance *instance, Status status, const char *category,
                  const char *message) {
    const Component *component = (const Component *)instance;
    if (component->logger != NULL) {
        component->logger(component->environment, (fmi3Status)status, category, message);
    }
}

const char *fmi3GetVersion(void) {
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t number,
                               const fmi3String categories[]) {
    return (fmi3Status)set_logging(c, __func__, on, number, categories);
}

/* Creation and destruction */

static Instance *create(const char *function, fmi3String name, fmi3String token,
                        fmi3InstanceEnvironment environment, fmi3LogMessageCallback logger) {
    Instance *instance = instance_create(sizeof(Component), name);

    if (instance == NULL) {
        return NULL;
    }
    ((Component *)instance)->logger = logger;
    ((Component *)instance)->environment = environment;
    if (!accepts(instance, function, token)) {
        instance_free(instance);
        return NULL;
    }
    return instance;
}

/* Destroys an instance that cannot do what the importer asks for. */
static fmi3Instance refuse(Instance *instance, const char *function, const char *reason) {
    if (instance != NULL) {
        report(instance, STATUS_ERROR, function, "%s", reason);
        instance_free(instance);
    }
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String,
                                          fmi3Boolean, fmi3Boolean,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback logger) {
    return refuse(create(__func__, name, token, environment, logger), __func__,
                  "the FMU is for co-simulation only");
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String,
                                               fmi3Boolean, fmi3Boolean,
                                               fmi3InstanceEnvironment environment,
                                               fmi3LogMessageCallback logger,
                                               fmi3ClockUpdateCallback, fmi3LockPreemptionCallback,
                                               fmi3UnlockPreemptionCallback) {
    return refuse(create(__func__, name, token, environment, logger), __func__,
                  "the FMU is for co-simulation only");
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String, fmi3Boolean,
                                         fmi3Boolean, fmi3Boolean event_mode, fmi3Boolean,
                                         const fmi3ValueReference[], size_t number_of_intermediates,
                                         fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback logger,
                                         fmi3IntermediateUpdateCallback) {
    Instance *instance = create(__func__, name, token, environment, logger);

    if (event_mode) {
        return refuse(instance, __func__, "the FMU has no Event Mode");
    }
    if (number_of_intermediates > 0) {
        return refuse(instance, __func__, "the FMU has no Intermediate Update Mode");
    }
    return instance;
}

void fmi3FreeInstance(fmi3Instance c) {
    instance_free(c);
}

/* Initialization, termination and reset */

/* Also sets up the experiment. If the times are not a time span, the phase does not change. */
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean, fmi3Float64,
                                       fmi3Float64 start_time, fmi3Boolean stop_time_defined,
                                       fmi3Float64 stop_time) {
    const Status status =
        set_up_experiment(c, __func__, start_time, stop_time_defined, stop_time);
    return (fmi3Status)(status == STATUS_OK ? enter_initialization(c, __func__) : status);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    return (fmi3Status)exit_initialization(c, __func__);
}

fmi3Status fmi3Terminate(fmi3Instance c) {
    return (fmi3Status)terminate(c, __func__);
}

fmi3Status fmi3Reset(fmi3Instance c) {
    return (fmi3Status)reset(c, __func__);
}

/* Variables */

/* All variables are scalars, so there are as many values as value references. */
static Status check_sizes(const Instance *instance, const char *function, size_t references,
                          size_t values) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    return references == values ? STATUS_OK
                                : report(instance, STATUS_ERROR, function,
                                         "the variables are scalars, but there are %u value "
                                         "references and %u values",
                                         (unsigned)references, (unsigned)values);
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference references[], size_t number,
                          fmi3Float64 values[], size_t number_of_values) {
    const Status status = check_sizes(c, __func__, number, number_of_values);
    return (fmi3Status)(status == STATUS_OK ? get_reals(c, __func__, references, number, values)
                                            : status);
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference references[], size_t number,
                          const fmi3Float64 values[], size_t number_of_values) {
    const Status status = check_sizes(c, __func__, number, number_of_values);
    return (fmi3Status)(status == STATUS_OK ? set_reals(c, __func__, references, number, values)
                                            : status);
}

fmi3Status fmi3GetInt64(fmi3Instance c, const fmi3ValueReference references[], size_t number,
                        fmi3Int64 values[], size_t number_of_values) {
    const Status status = check_sizes(c, __func__, number, number_of_values);
    return (fmi3Status)(status == STATUS_OK
                            ? get_enumerations(c, __func__, references, number, values)
                            : status);
}

fmi3Status fmi3SetInt64(fmi3Instance c, const fmi3ValueReference references[], size_t number,
                        const fmi3Int64 values[], size_t number_of_values) {
    const Status status = check_sizes(c, __func__, number, number_of_values);
    return (fmi3Status)(status == STATUS_OK
                            ? set_enumerations(c, __func__, references, number, values)
                            : status);
}

/* Access to variables of a type that the model does not use. */
#define NO_VARIABLES_OF(Type)                                                                    \
    fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference[], size_t number,          \
                             fmi3##Type[], size_t) {                                             \
        return (fmi3Status)no_such_variables(c, __func__, number);                               \
    }                                                                                            \
    fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference[], size_t number,          \
                             const fmi3##Type[], size_t) {                                       \
        return (fmi3Status)no_such_variables(c, __func__, number);                               \
    }

NO_VARIABLES_OF(Float32)
NO_VARIABLES_OF(Int8)
NO_VARIABLES_OF(UInt8)
NO_VARIABLES_OF(Int16)
NO_VARIABLES_OF(UInt16)
NO_VARIABLES_OF(Int32)
NO_VARIABLES_OF(UInt32)
NO_VARIABLES_OF(UInt64)
NO_VARIABLES_OF(Boolean)
NO_VARIABLES_OF(String)

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference[], size_t number, size_t[],
                         fmi3Binary[], size_t) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference[], size_t number, const size_t[],
                         const fmi3Binary[], size_t) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference[], size_t number, fmi3Clock[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference[], size_t number,
                        const fmi3Clock[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

/* FMU states */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    return (fmi3Status)get_state(c, __func__, state);
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    return (fmi3Status)set_state(c, __func__, state);
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    return (fmi3Status)free_state(c, __func__, state);
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState, size_t *size) {
    return (fmi3Status)serialized_size(c, __func__, size);
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[],
                                 size_t size) {
    return (fmi3Status)serialize_state(c, __func__, state, bytes, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state) {
    return (fmi3Status)deserialize_state(c, __func__, bytes, size, state);
}

/* Partial derivatives */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                        size_t number_of_unknowns,
                                        const fmi3ValueReference knowns[], size_t number_of_knowns,
                                        const fmi3Float64 seed[], size_t seed_size,
                                        fmi3Float64 sensitivity[], size_t sensitivity_size) {
    if (check_sizes(c, __func__, number_of_knowns, seed_size) != STATUS_OK ||
        check_sizes(c, __func__, number_of_unknowns, sensitivity_size) != STATUS_OK) {
        return fmi3Error;
    }
    return (fmi3Status)directional_derivative(c, __func__, unknowns, number_of_unknowns, knowns,
                                              number_of_knowns, seed, sensitivity);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference[], size_t,
                                    const fmi3ValueReference[], size_t, const fmi3Float64[], size_t,
                                    fmi3Float64[], size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference, size_t *) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference, size_t[],
                                       fmi3ValueReference[], size_t[], fmi3DependencyKind[],
                                       size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

/* Co-simulation. Steps cause no events, never return early and never end the simulation. */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean,
                      fmi3Boolean *event_handling_needed, fmi3Boolean *terminate_simulation,
                      fmi3Boolean *early_return, fmi3Float64 *last_successful_time) {
    const Instance *instance = c;
    const Status status = do_step(c, __func__, time, step);

    if (instance != NULL) {
        *event_handling_needed = false;
        *terminate_simulation = false;
        *early_return = false;
        *last_successful_time = instance->simulation.reals.time;
    }
    return (fmi3Status)status;
}

fmi3Status fmi3EnterStepMode(fmi3Instance c) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference[], size_t,
                                    const fmi3Int32[], fmi3Float64[], size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

/* Configuration and events */

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3EnterEventMode(fmi3Instance c) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *, fmi3Boolean *, fmi3Boolean *,
                                    fmi3Boolean *, fmi3Boolean *, fmi3Float64 *) {
    return (fmi3Status)not_supported(c, __func__);
}

/* Clocks */

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference[], size_t number,
                                  fmi3Float64[], fmi3IntervalQualifier[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference[], size_t number,
                                   fmi3UInt64[], fmi3UInt64[], fmi3IntervalQualifier[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference[], size_t number,
                               fmi3Float64[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference[], size_t number,
                                fmi3UInt64[], fmi3UInt64[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference[], size_t number,
                                  const fmi3Float64[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference[], size_t number,
                                   const fmi3UInt64[], const fmi3UInt64[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference[], size_t number,
                               const fmi3Float64[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference[], size_t number,
                                const fmi3UInt64[], const fmi3UInt64[]) {
    return (fmi3Status)no_such_variables(c, __func__, number);
}

/* Model exchange and scheduled execution */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean, fmi3Boolean *, fmi3Boolean *) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64[], size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64[], size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64[], size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64[], size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64[], size_t) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *) {
    return (fmi3Status)not_supported(c, __func__);
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference, fmi3Float64) {
    return (fmi3Status)not_supported(c, __func__);
}
