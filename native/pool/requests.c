/* Answers to requests of a pool's owner, as forms. */

#include "pool/requests.h"

#include <stdlib.h>
#include <string.h>

#include "pool/derivatives.h"
#include "pool/snapshots.h"
#include "pool/states.h"
#include "system/system.h"

typedef struct {
    Pool *pool;
    Matrix inputs;
    Reader *reader;
    Writer *writer;
} Asked;

static void begin_again(Writer *writer) {
    writer->size = 0;
    writer->failed = false;
}

Answer answer_refusal(Writer *writer, const char *why) {
    begin_again(writer);
    write_text(writer, why);
    return ANSWER_ERROR;
}

/* Whether there is a failure is the first number. */
static void write_failure(Writer *writer, Pool *pool, size_t index) {
    Failure failure = {.doing = NULL};
    const bool found = pool_failure(pool, index, &failure);

    write_integer(writer, found);
    if (found) {
        write_text(writer, failure.doing);
        write_integer(writer, failure.in_warm_up);
        write_integer(writer, failure.status);
        write_number(writer, failure.time);
        write_integer(writer, failure.reference);
        write_text(writer, failure.said);
        write_integer(writer, failure.values != NULL);
        write_block(writer, failure.values, failure.number_of_values * sizeof(double));
        write_text(writer, failure.part);
        free(failure.said);
        free(failure.values);
    }
}

Answer answer_after(Pool *pool, const Reader *reader, Writer *writer, ptrdiff_t failed) {
    if (reader->fault != NULL) {
        return answer_refusal(writer, reader->fault);
    }
    if (failed < 0) {
        return ANSWER_RESULT;
    }
    begin_again(writer);
    write_integer(writer, failed);
    write_failure(writer, pool, (size_t)failed);
    return ANSWER_TROUBLE;
}

static Answer answer(Asked *a, ptrdiff_t failed) {
    return answer_after(a->pool, a->reader, a->writer, failed);
}

/* Values */

static size_t count_of(const Asked *a) {
    return a->pool->settings.count;
}

/* Values of all instances, which the caller sets. */
static double *room_for(Asked *a, size_t values) {
    return (double *)(void *)write_room(a->writer, values * count_of(a) * sizeof(double));
}

static Answer answer_write(Asked *a) {
    Access access;
    size_t count;
    ptrdiff_t failed = -1;

    read_access(a->reader, a->pool->settings.fmi, &access);
    const double *values = read_array(a->reader, sizeof *values, &count);
    if (count != access.count * count_of(a)) {
        reader_refuse(a->reader, "the values of variables differ in number");
    }
    if (a->reader->fault == NULL) {
        failed = pool_write(a->pool, &access, values);
    }
    access_close(&access);
    return answer(a, failed);
}

static Answer answer_read(Asked *a) {
    Access access;
    ptrdiff_t failed = -1;

    if (read_access(a->reader, a->pool->settings.fmi, &access)) {
        double *values = room_for(a, access.count);
        failed = values == NULL ? -1 : pool_read(a->pool, &access, values);
    }
    access_close(&access);
    return answer(a, failed);
}

/* Directional or adjoint derivatives of an FMU; in a system, of one of its parts. */
static Answer answer_differentiate(Asked *a) {
    const Settings *s = &a->pool->settings;
    const bool adjoint = read_flag(a->reader);
    const int64_t parts = s->system == NULL ? 1 : (int64_t)s->system->count;
    const size_t part = (size_t)read_integer_in(a->reader, 0, parts - 1);
    const Fmi *fmi = s->system == NULL ? s->fmi : s->system->parts[part].fmi;
    Access seeded, others;
    ptrdiff_t failed = -1;

    read_access(a->reader, fmi, &seeded);
    read_access(a->reader, fmi, &others);
    double *derivatives = room_for(a, seeded.count * others.count);
    if (a->reader->fault == NULL && derivatives != NULL) {
        const Question question = {adjoint, part, &seeded, &others};
        failed = pool_differentiate(a->pool, a->inputs, &question, derivatives);
    }
    access_close(&seeded);
    access_close(&others);
    return answer(a, failed);
}

/* States */

/* Numbers of instances, each there once, so that no two threads work on it. */
static const int64_t *read_instances(Asked *a, size_t *count) {
    const size_t n = count_of(a);
    const int64_t *indices = read_array(a->reader, sizeof *indices, count);
    char *seen = calloc(n, 1);

    if (seen == NULL) {
        reader_refuse(a->reader, "out of memory");
    }
    for (size_t i = 0; i < *count && a->reader->fault == NULL; i++) {
        if (indices[i] < 0 || (size_t)indices[i] >= n || seen[indices[i]]) {
            reader_refuse(a->reader, "a list of instances is damaged");
        } else {
            seen[indices[i]] = 1;
        }
    }
    free(seen);
    return indices;
}

static Answer answer_save(Asked *a) {
    size_t count, number_dropped;
    ptrdiff_t failed = -1;
    const int64_t *indices = read_instances(a, &count);
    const bool records = read_flag(a->reader);
    const int64_t number = read_integer(a->reader);
    const int64_t *dropped = read_array(a->reader, sizeof *dropped, &number_dropped);

    if (number != NO_SNAPSHOT && !a->pool->settings.can_save) {
        reader_refuse(a->reader, "the FMU cannot get and set its state");
    }
    if (a->reader->fault == NULL) {
        for (size_t i = 0; i < number_dropped; i++) {
            snapshot_drop(a->pool, dropped[i]);
        }
        failed = number == NO_SNAPSHOT
                     ? pool_save_states(a->pool, indices, count, records, a->writer)
                     : snapshot_save(a->pool, number, indices, count);
    }
    return answer(a, failed);
}

/* Restores sound states in instances, or those of a snapshot. */
static Answer restore(Asked *a, const int64_t *indices, const State *states,
                      const Snapshot *snapshot, size_t count) {
    for (size_t i = 0; i < count && snapshot == NULL && a->reader->fault == NULL; i++) {
        if (!state_is_sound(a->pool, states[i])) {
            reader_refuse(a->reader, "a state is damaged, or not of this FMU");
        }
    }
    if (a->reader->fault == NULL) {
        for (size_t i = 0; i < count; i++) {
            a->pool->chosen[i] = (uint32_t)indices[i];
        }
        pool_restore(a->pool, states, snapshot, count);
    }
    return answer(a, -1);
}

static Answer restore_snapshot(Asked *a, int64_t number, const int64_t *indices, size_t count) {
    const Snapshot *snapshot =
        a->reader->fault == NULL ? snapshot_of(a->pool, number, indices, count) : NULL;

    if (snapshot == NULL) {
        reader_refuse(a->reader, "the snapshot is of an instance that has been replaced since");
    }
    return restore(a, indices, NULL, snapshot, count);
}

/* Reads states until the form ends, at most so many. Returns their number. */
static size_t read_states(Reader *reader, State *states, size_t most) {
    size_t number = 0;

    while (number < most && reader->fault == NULL && reader->at != reader->end) {
        const Block block = read_block(reader);
        states[number++] = (State){block.bytes, block.size};
    }
    reader_require(reader, reader->at == reader->end, "the states differ in number");
    return number;
}

/* Sets the state of each of so many instances. */
static void find_states(Reader *reader, State *states, size_t count) {
    size_t number;
    const int64_t *places = read_array(reader, sizeof *places, &number);
    State *distinct = reader_room(reader, count, sizeof *distinct);

    reader_require(reader, number == count, "the states differ in number");
    const uint64_t found = reader->fault == NULL ? read_states(reader, distinct, count) : 0;
    for (size_t i = 0; i < count && reader->fault == NULL; i++) {
        const uint64_t place = (uint64_t)places[i];
        if (reader_require(reader, place < found, "there is no such state")) {
            states[i] = distinct[place];
        }
    }
    free(distinct);
}

static Answer answer_restore(Asked *a) {
    size_t count;
    const int64_t *indices = read_instances(a, &count);
    const int64_t number = read_integer(a->reader);

    if (number != NO_SNAPSHOT) {
        return restore_snapshot(a, number, indices, count);
    }
    State *states = reader_room(a->reader, count, sizeof *states);
    if (a->reader->fault == NULL) {
        find_states(a->reader, states, count);
    }
    const Answer result = restore(a, indices, states, NULL, count);
    free(states);
    return result;
}

/* Questions */

static Answer answer_failure(Asked *a) {
    const size_t index = (size_t)read_integer_in(a->reader, 0, (int64_t)count_of(a) - 1);

    if (a->reader->fault == NULL) {
        write_failure(a->writer, a->pool, index);
    }
    return answer(a, -1);
}

Answer pool_answer(Pool *pool, Matrix inputs, Request request, Reader *reader, Writer *writer) {
    static Answer (*const answers[REQUESTS])(Asked *) = {
        [REQUEST_WRITE] = answer_write,
        [REQUEST_READ] = answer_read,
        [REQUEST_SAVE] = answer_save,
        [REQUEST_RESTORE] = answer_restore,
        [REQUEST_FAILURE] = answer_failure,
        [REQUEST_DIFFERENTIATE] = answer_differentiate,
    };
    Asked asked = {pool, inputs, reader, writer};

    return answers[request] == NULL ? answer_refusal(writer, "a pool does not answer this")
                                    : answers[request](&asked);
}
