/* The functions of FMI 3.0 for co-simulation. */

#include "fmi3Functions.h"

#define FMI(name) fmi3##name
#define OF_STATE(verb, noun) fmi3##verb##FMUState##noun
#define DESERIALIZE fmi3DeserializeFMUState
#define AND_LENGTH , size_t length
#define FITS (n == length)

#include "fmu_instance.h"

static void emit(const void *instance, const char *message) {
    const Controller *controller = instance;
    fmi3LogMessageCallback log_message;
    memcpy(&log_message, &controller->logger, sizeof log_message); /* C has no cast between them */
    log_message(controller->environment, fmi3Error, "logStatusError", message);
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n,
                               const fmi3String categories[]) {
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String folder,
                                          fmi3Boolean visible, fmi3Boolean on,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log_message) {
    return NULL;
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String folder, fmi3Boolean visible, fmi3Boolean on,
    fmi3Boolean uses_events, fmi3Boolean may_return_early,
    const fmi3ValueReference intermediate_variables[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log_message,
    fmi3IntermediateUpdateCallback intermediate_update) {
    Controller *controller = create(name, token);
    if (controller != NULL && log_message != NULL) {
        memcpy(&controller->logger, &log_message, sizeof controller->logger);
        controller->environment = environment;
        controller->emit = emit;
    }
    return controller;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String folder,
                                               fmi3Boolean visible, fmi3Boolean on,
                                               fmi3InstanceEnvironment environment,
                                               fmi3LogMessageCallback log_message,
                                               fmi3ClockUpdateCallback clock_update,
                                               fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
    return NULL;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop) {
    Memory *memory = &((Controller *)c)->memory;
    memory->start = memory->time = start;
    memory->mode = INITIALIZATION;
    return fmi3OK;
}

ACCESS(Float32, 'f')
ACCESS(Float64, 'd')
ACCESS(Int8, 'b')
ACCESS(UInt8, 'B')
ACCESS(Int16, 'h')
ACCESS(UInt16, 'H')
ACCESS(Int32, 'i')
ACCESS(UInt32, 'I')
ACCESS(Int64, 'q')
ACCESS(UInt64, 'Q')
ACCESS(Boolean, '?')

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 size, fmi3Boolean no_set_state,
                      fmi3Boolean *needs_events, fmi3Boolean *terminates, fmi3Boolean *is_early,
                      fmi3Float64 *last_time) {
    const bool done = step(c, time, size);
    *needs_events = *terminates = *is_early = false;
    *last_time = ((Controller *)c)->memory.time;
    return OR_ERROR(done);
}

/* What a controller does not have: functions that fail, and those of values that it has none of. */

#define LACKING(name, ...)                                                                         \
    fmi3Status name(__VA_ARGS__) {                                                                 \
        return fmi3Error;                                                                          \
    }

LACKING(fmi3EnterEventMode, fmi3Instance c)
OF_NONE(GetString, fmi3String values[], size_t nValues)
OF_NONE(GetBinary, size_t valueSizes[], fmi3Binary values[], size_t nValues)
OF_NONE(GetClock, fmi3Clock values[])
OF_NONE(SetString, const fmi3String values[], size_t nValues)
OF_NONE(SetBinary, const size_t valueSizes[], const fmi3Binary values[], size_t nValues)
OF_NONE(SetClock, const fmi3Clock values[])
LACKING(fmi3GetNumberOfVariableDependencies, fmi3Instance c, fmi3ValueReference valueReference,
        size_t *nDependencies)
LACKING(fmi3GetVariableDependencies, fmi3Instance c, fmi3ValueReference dependent,
        size_t elementIndicesOfDependent[], fmi3ValueReference independents[],
        size_t elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[],
        size_t nDependencies)
LACKING(fmi3GetDirectionalDerivative, fmi3Instance c, const fmi3ValueReference unknowns[],
        size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns,
        const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity)
LACKING(fmi3GetAdjointDerivative, fmi3Instance c, const fmi3ValueReference unknowns[],
        size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns,
        const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity)
LACKING(fmi3EnterConfigurationMode, fmi3Instance c)
LACKING(fmi3ExitConfigurationMode, fmi3Instance c)
OF_NONE(GetIntervalDecimal, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
OF_NONE(GetIntervalFraction, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
        fmi3IntervalQualifier qualifiers[])
OF_NONE(GetShiftDecimal, fmi3Float64 shifts[])
OF_NONE(GetShiftFraction, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
OF_NONE(SetIntervalDecimal, const fmi3Float64 intervals[])
OF_NONE(SetIntervalFraction, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
OF_NONE(SetShiftDecimal, const fmi3Float64 shifts[])
OF_NONE(SetShiftFraction, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
LACKING(fmi3EvaluateDiscreteStates, fmi3Instance c)
LACKING(fmi3UpdateDiscreteStates, fmi3Instance c, fmi3Boolean *discreteStatesNeedUpdate,
        fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
        fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
        fmi3Float64 *nextEventTime)
LACKING(fmi3EnterContinuousTimeMode, fmi3Instance c)
LACKING(fmi3CompletedIntegratorStep, fmi3Instance c, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
        fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation)
LACKING(fmi3SetTime, fmi3Instance c, fmi3Float64 time)
LACKING(fmi3SetContinuousStates, fmi3Instance c, const fmi3Float64 continuousStates[],
        size_t nContinuousStates)
LACKING(fmi3GetContinuousStateDerivatives, fmi3Instance c, fmi3Float64 derivatives[],
        size_t nContinuousStates)
LACKING(fmi3GetEventIndicators, fmi3Instance c, fmi3Float64 eventIndicators[],
        size_t nEventIndicators)
LACKING(fmi3GetContinuousStates, fmi3Instance c, fmi3Float64 continuousStates[],
        size_t nContinuousStates)
LACKING(fmi3GetNominalsOfContinuousStates, fmi3Instance c, fmi3Float64 nominals[],
        size_t nContinuousStates)
LACKING(fmi3GetNumberOfEventIndicators, fmi3Instance c, size_t *nEventIndicators)
LACKING(fmi3GetNumberOfContinuousStates, fmi3Instance c, size_t *nContinuousStates)
LACKING(fmi3EnterStepMode, fmi3Instance c)
LACKING(fmi3GetOutputDerivatives, fmi3Instance c, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues)
LACKING(fmi3ActivateModelPartition, fmi3Instance c, fmi3ValueReference clockReference,
        fmi3Float64 activationTime)
