/* Access to variables and to partial derivatives. */

#include "values.h"

#include "log.h"
#include "simulation.h"

/* The phases in which variables of a kind may be set. TUNES marks variables that may be set after
 * initialization and change the constants. FMI 1.0 has no tunable parameters. */
enum {
    BEFORE_STEPS = PHASE_INSTANTIATED | PHASE_EXPERIMENT_SET_UP | PHASE_INITIALIZATION,
    TUNES = 32,
    SET_CALCULATED = 0,
    SET_INPUT = BEFORE_STEPS | PHASE_STEP,
    SET_FIXED = BEFORE_STEPS,
    SET_TUNABLE = FMI_VERSION == 1 ? BEFORE_STEPS : BEFORE_STEPS | PHASE_STEP | TUNES
};

enum { READABLE = PHASE_INITIALIZATION | PHASE_STEP | PHASE_TERMINATED };

#define REAL_SETTABLE(name, kind, start) SET_##kind,
#define REAL_NAME(name, kind, start) #name,
#define ENUMERATION_SETTABLE(name, kind, start, items) SET_##kind,
#define ENUMERATION_ITEMS(name, kind, start, items) items,
#define ENUMERATION_NAME(name, kind, start, items) #name,

static const uint8_t real_settable[] = {MODEL_REALS(REAL_SETTABLE)};
static const uint8_t enumeration_settable[] = {MODEL_ENUMERATIONS(ENUMERATION_SETTABLE)};
static const int32_t enumeration_items[] = {MODEL_ENUMERATIONS(ENUMERATION_ITEMS)};

/* Names by value reference: the enumerations follow the Reals. */
static const char *const names[] = {MODEL_REALS(REAL_NAME) MODEL_ENUMERATIONS(ENUMERATION_NAME)};

static Status unknown_reference(const Instance *instance, const char *function,
                                uint32_t reference) {
    if (reference < NUMBER_OF_REALS + NUMBER_OF_ENUMERATIONS) {
        return report(instance, STATUS_ERROR, function, "the variable %s has another type",
                      names[reference]);
    }
    return report(instance, STATUS_ERROR, function, "no variable has the value reference %u",
                  (unsigned)reference);
}

static Status not_settable(const Instance *instance, const char *function, uint32_t reference,
                           int settable) {
    return report(instance, STATUS_ERROR, function, "the variable %s must not be set%s",
                  names[reference],
                  settable == SET_CALCULATED                       ? ""
                  : instance->simulation.phase == PHASE_TERMINATED ? " after termination"
                                                                   : " after initialization");
}

/* Gets values where a reference may be unknown or calculated on demand. */
RARE static Status get_any_reals(Instance *instance, const char *function,
                                 const uint32_t references[], size_t number, double values[]) {
    for (size_t i = 0; i < number; i++) {
        if (references[i] >= NUMBER_OF_REALS) {
            return unknown_reference(instance, function, references[i]);
        }
        if (refresh(instance, function) != STATUS_OK) {
            return STATUS_ERROR;
        }
        values[i] = instance->simulation.reals.values[references[i]];
    }
    return STATUS_OK;
}

Status get_reals(Instance *instance, const char *function, const uint32_t references[],
                 size_t number, double values[]) {
    const Status status = check_phase(instance, function, READABLE);
    if (status != STATUS_OK) {
        return status;
    }
    /* After initialization, only derivatives and what depends on inputs are computed on demand. */
    const uint32_t ready =
        instance->simulation.phase == PHASE_INITIALIZATION ? 0 : FIRST_ON_DEMAND;
    for (size_t i = 0; i < number; i++) {
        if (references[i] >= ready) {
            return get_any_reals(instance, function, references, number, values);
        }
        values[i] = instance->simulation.reals.values[references[i]];
    }
    return STATUS_OK;
}

static void assign(Reals *reals, const uint32_t references[], size_t number,
                   const double values[]) {
#pragma clang loop unroll(disable) /* there is usually one value */
    for (size_t i = 0; i < number; i++) {
        reals->values[references[i]] = values[i];
    }
}

/* Sets tunable parameters, and the values set in the same call. */
static Status tune(Instance *instance, const char *function, const uint32_t references[],
                   size_t number, const double values[]) {
    Simulation *s = &instance->simulation;
    Simulation tuned = *s;

    assign(&tuned.reals, references, number, values);
    const char *problem = model_constants(&tuned.reals, tuned.enumerations, &tuned.constants);
    if (problem != NULL) {
        return report(instance, STATUS_ERROR, function, "%s", problem);
    }
    tuned.stale = true;
    *s = tuned;
    return STATUS_OK;
}

/* Sets values where at least one is tunable or must not be set. */
RARE static Status set_any_reals(Instance *instance, const char *function,
                                 const uint32_t references[], size_t number,
                                 const double values[]) {
    for (size_t i = 0; i < number; i++) {
        if (references[i] >= NUMBER_OF_REALS) {
            return unknown_reference(instance, function, references[i]);
        }
        const int settable = real_settable[references[i]];
        if (!(settable & instance->simulation.phase)) {
            return not_settable(instance, function, references[i], settable);
        }
    }
    return tune(instance, function, references, number, values);
}

Status set_reals(Instance *instance, const char *function, const uint32_t references[],
                 size_t number, const double values[]) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    const int32_t phase = instance->simulation.phase;
    const int32_t asked = phase == PHASE_STEP ? phase | TUNES : phase;
    for (size_t i = 0; i < number; i++) {
        if (references[i] >= NUMBER_OF_REALS || (real_settable[references[i]] & asked) != phase) {
            return set_any_reals(instance, function, references, number, values);
        }
    }
    assign(&instance->simulation.reals, references, number, values);
    instance->simulation.stale = true;
    return STATUS_OK;
}

Status get_enumerations(const Instance *instance, const char *function,
                        const uint32_t references[], size_t number, Integer values[]) {
    const Status status = check_phase(instance, function, READABLE);
    for (size_t i = 0; status == STATUS_OK && i < number; i++) {
        const uint32_t index = references[i] - NUMBER_OF_REALS;
        if (index >= NUMBER_OF_ENUMERATIONS) {
            return unknown_reference(instance, function, references[i]);
        }
        values[i] = instance->simulation.enumerations[index];
    }
    return status;
}

static Status check_item(const Instance *instance, const char *function, uint32_t reference,
                         Integer value) {
    const uint32_t index = reference - NUMBER_OF_REALS;
    if (index >= NUMBER_OF_ENUMERATIONS) {
        return unknown_reference(instance, function, reference);
    }
    if (!(enumeration_settable[index] & instance->simulation.phase)) {
        return not_settable(instance, function, reference, enumeration_settable[index]);
    }
    if (value < 1 || value > enumeration_items[index]) {
        return report(instance, STATUS_ERROR, function,
                      "the variable %s must be in 1..%d, not %lld", names[reference],
                      (int)enumeration_items[index], (long long)value);
    }
    return STATUS_OK;
}

Status set_enumerations(Instance *instance, const char *function, const uint32_t references[],
                        size_t number, const Integer values[]) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    for (size_t i = 0; i < number; i++) {
        if (check_item(instance, function, references[i], values[i]) != STATUS_OK) {
            return STATUS_ERROR;
        }
    }
    for (size_t i = 0; i < number; i++) {
        instance->simulation.enumerations[references[i] - NUMBER_OF_REALS] = (int32_t)values[i];
    }
    instance->simulation.stale = true;
    return STATUS_OK;
}

Status no_such_variables(const Instance *instance, const char *function, size_t number) {
    if (instance == NULL) {
        return STATUS_ERROR;
    }
    return number == 0 ? STATUS_OK
                       : report(instance, STATUS_ERROR, function,
                                "the model has no variables of this type");
}

static bool is_known(uint32_t reference) {
    return reference < NUMBER_OF_REALS &&
           (reference - FIRST_STATE < NUMBER_OF_STATES || real_settable[reference] == SET_INPUT);
}

static bool is_unknown(uint32_t reference) {
    return reference < NUMBER_OF_REALS && reference != VR_time &&
           real_settable[reference] == SET_CALCULATED;
}

static Status check_all(const Instance *instance, const char *function,
                        const uint32_t references[], size_t number,
                        bool (*is_allowed)(uint32_t), const char *what) {
    for (size_t i = 0; i < number; i++) {
        if (!is_allowed(references[i])) {
            return report(instance, STATUS_ERROR, function, "value reference %u is not %s",
                          (unsigned)references[i], what);
        }
    }
    return STATUS_OK;
}

Status directional_derivative(Instance *instance, const char *function, const uint32_t unknowns[],
                              size_t number_of_unknowns, const uint32_t knowns[],
                              size_t number_of_knowns, const double seed[], double sensitivity[]) {
    Reals direction = {.values = {0.0}};

    if (check_phase(instance, function, READABLE) != STATUS_OK ||
        check_all(instance, function, knowns, number_of_knowns, is_known, "a state or an input") !=
            STATUS_OK ||
        check_all(instance, function, unknowns, number_of_unknowns, is_unknown,
                  "an output or a derivative") != STATUS_OK ||
        refresh(instance, function) != STATUS_OK) {
        return STATUS_ERROR;
    }
    for (size_t i = 0; i < number_of_knowns; i++) {
        direction.values[knowns[i]] += seed[i];
    }
    model_tangent(&instance->simulation.reals, &instance->simulation.constants, &direction);
    for (size_t i = 0; i < number_of_unknowns; i++) {
        sensitivity[i] = direction.values[unknowns[i]];
    }
    return STATUS_OK;
}
