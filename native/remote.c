#include "remote.h"

#include <stdio.h>
#include <string.h>

#include "far.h"
#include "served.h"
#include "texts.h"

#if defined _WIN32

const Fmi *remote_table(int64_t version) {
    (void)version;
    return NULL;
}

bool remote_open(Library *library, const Component *part, size_t parts, char *error, size_t size) {
    (void)library;
    (void)part;
    (void)parts;
    snprintf(error, size, "components have processes of their own on Linux and macOS only");
    return false;
}

void remote_close(Library *library) {
    (void)library;
}

#else

/* Initialization: the worker calls back for the start values, and for the exchange of values. */

static Status called_back(Far *me, StartValues values) {
    uint8_t what;

    TAKE(&me->host->in, what);
    return what == CALLED_FOR_EXCHANGE ? exchange_in(values) : values.set(values.context);
}

static bool go_on(Far *me, Status status, char *answer) {
    const int32_t number = status;

    packet_clear(&me->host->out);
    PUT(&me->host->out, number);
    return far_send(me, GO_ON, PATIENT, answer);
}

static void put_experiment(Packet *packet, const Experiment *experiment) {
    PUT(packet, experiment->start_time);
    PUT(packet, experiment->stop_time);
    PUT(packet, experiment->tolerance);
    PUT(packet, experiment->has_stop_time);
    PUT(packet, experiment->has_tolerance);
}

static Status initialize(const Library *library, void *component, const Experiment *experiment,
                         StartValues values, const char **doing) {
    Far *me = component;
    const bool exchanges = values.exchange != NULL;
    Status inner = STATUS_OK, status = STATUS_FATAL;
    char answer;

    (void)library;
    far_made_anew(me);
    far_begin(me);
    far_forget_values(me);
    put_experiment(&me->host->out, experiment);
    PUT(&me->host->out, exchanges);
    me->holds = true;
    bool answered = far_send(me, ASK_INITIALIZE, PATIENT, &answer);
    while (answered && answer == CALL_BACK) {
        const Status own = called_back(me, values);
        inner = own > inner ? own : inner;
        answered = go_on(me, own, &answer);
    }
    me->holds = false;
    if (answered) {
        status = far_take_status(me);
        const char *text = text_with(text_number(packet_take_text(&me->host->in)));
        *doing = inner > STATUS_WARNING || text == NULL ? *doing : text;
        host_praise(me->host);
    }
    far_end(me);
    me->steps = status <= STATUS_WARNING;
    return status;
}

/* Values. A list of the part is known by the place of its references. */

static ptrdiff_t group_of(const Access *access, const uint32_t *references) {
    for (size_t i = 0; i < access->number_of_groups; i++) {
        if (access->groups[i].references == references) {
            return (ptrdiff_t)i;
        }
    }
    return -1;
}

static void put_asked(Packet *packet, Type type, const uint32_t *references, size_t count,
                      size_t size) {
    packet_put_size(packet, type);
    packet_put_size(packet, count);
    packet_put_size(packet, size);
    packet_put(packet, references, count * sizeof *references);
}

/* Sets values at once. */
static Status set_now(Far *me, Type type, const uint32_t *references, size_t count,
                      const void *values, size_t size) {
    far_begin(me);
    put_asked(&me->host->out, type, references, count, size);
    packet_put(&me->host->out, values, size * value_size(me->part->fmi, type));
    const Status status = far_ask(me, ASK_SET);
    far_end(me);
    return status;
}

Status far_set_waiting(Far *me) {
    const Access *inputs = &me->part->inputs;
    const uint32_t waiting = me->waiting;
    Status status = STATUS_OK;

    me->waiting = 0;
    for (size_t i = 0; waiting >> i != 0 && status <= STATUS_WARNING; i++) {
        const Group *group = &inputs->groups[i];
        if ((waiting >> i & 1) != 0) {
            status = set_now(me, group->type, group->references, group->count,
                             far_input_values(me, i), group->size);
        }
    }
    return status;
}

static Status set(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, const void *values, size_t size) {
    Far *me = component;
    const ptrdiff_t group = me->steps ? group_of(&me->part->inputs, references) : -1;

    (void)library;
    me->fresh = 0;
    if (group >= 0) {
        memcpy(far_input_values(me, (size_t)group), values,
               far_size_of_group(&me->part->inputs, (size_t)group));
        me->waiting |= 1u << group;
        return STATUS_OK;
    }
    const Status status = far_set_waiting(me);
    return status > STATUS_WARNING ? status
                                   : set_now(me, type, references, count, values, size);
}

static Status get(const Library *library, void *component, Type type, const uint32_t *references,
                  size_t count, void *values, size_t size) {
    Far *me = component;
    const ptrdiff_t group = group_of(&me->part->outputs, references);

    (void)library;
    if (group >= 0 && (me->fresh >> group & 1) != 0) {
        memcpy(values, far_output_values(me, (size_t)group),
               far_size_of_group(&me->part->outputs, (size_t)group));
        return (Status)me->got[group];
    }
    Status status = far_set_waiting(me);
    if (status > STATUS_WARNING) {
        return status;
    }
    far_begin(me);
    put_asked(&me->host->out, type, references, count, size);
    status = far_ask(me, ASK_GET);
    if (status <= STATUS_WARNING) {
        packet_take(&me->host->in, values, size * value_size(me->part->fmi, type));
    }
    far_end(me);
    return status;
}

static Status set_string(const Library *library, void *component, uint32_t reference,
                         const char *text) {
    Far *me = component;

    (void)library;
    me->fresh = 0;
    far_begin(me);
    packet_put_size(&me->host->out, reference);
    packet_put_text(&me->host->out, text);
    const Status status = far_ask(me, ASK_SET_STRING);
    far_end(me);
    return status;
}

static Status get_string(const Library *library, void *component, uint32_t reference,
                         const char **text) {
    Far *me = component;
    Status status = far_set_waiting(me);

    (void)library;
    if (status > STATUS_WARNING) {
        return status;
    }
    far_begin(me);
    packet_put_size(&me->host->out, reference);
    status = far_ask(me, ASK_GET_STRING);
    if (status <= STATUS_WARNING) {
        *text = text_with(text_number(packet_take_text(&me->host->in))); /* the packet changes */
        status = *text == NULL ? STATUS_ERROR : status; /* no room for another one */
    }
    far_end(me);
    return status;
}

/* Steps */

static void take_outputs(Far *me) {
    const Access *outputs = &me->part->outputs;
    Packet *in = &me->host->in;

    for (size_t i = 0; i < outputs->number_of_groups; i++) {
        TAKE(in, me->got[i]);
        if (!in->sound || me->got[i] > STATUS_WARNING) {
            return;
        }
        packet_take(in, far_output_values(me, i), far_size_of_group(outputs, i));
        me->fresh |= in->sound ? 1u << i : 0;
    }
}

static Status do_step(const Library *library, void *component, double time, double step,
                      bool no_return) {
    Far *me = component;
    Packet *out = &me->host->out;

    (void)library;
    far_begin(me);
    PUT(out, time);
    PUT(out, step);
    PUT(out, no_return);
    PUT(out, me->waiting);
    for (size_t i = 0; me->waiting >> i != 0; i++) {
        if ((me->waiting >> i & 1) != 0) {
            packet_put(out, far_input_values(me, i), far_size_of_group(&me->part->inputs, i));
        }
    }
    far_forget_values(me);
    const Status status = far_ask(me, ASK_STEP);
    if (status <= STATUS_WARNING || status == STATUS_TERMINATED) {
        take_outputs(me);
    }
    far_end(me);
    return status;
}

static bool exchange_one_by_one(const Library *library, const Exchange *e) {
    const Far *me = e->components[0];
    return exchange_by(me->part->fmi, library, e);
}

static Status reset(const Library *library, void *component) {
    Far *me = component;

    (void)library;
    far_forget_values(me);
    me->steps = false;
    return far_made_anew(me) ? STATUS_OK : far_ask_simply(me, ASK_RESET);
}

static Status terminate(const Library *library, void *component) {
    Far *me = component;

    (void)library;
    far_forget_values(me);
    me->steps = false;
    return far_ask_simply(me, ASK_TERMINATE);
}

/* Remote libraries are opened by remote_open. */
static bool bind(Library *library, char *error, size_t size) {
    (void)library;
    (void)error;
    (void)size;
    return true;
}

#define REMOTE_FUNCTIONS                                                                           \
    .bind = bind, .instantiate = far_instantiate, .initialize = initialize, .do_step = do_step,    \
    .exchange = exchange_one_by_one, .get = get, .set = set, .set_string = set_string,             \
    .get_string = get_string, .reset = reset, .terminate = terminate, .free_instance = far_free,   \
    .blamed = far_blamed, .drop = far_drop
#define REMOTE_STATES                                                                              \
    .choose_messages = far_choose_messages, .get_state = far_get_state,                            \
    .set_state = far_set_state, .free_state = far_free_state, .state_size = far_state_size,        \
    .serialize = far_serialize, .deserialize = far_deserialize

const Fmi *remote_table(int64_t version) {
    static const Fmi first = {.boolean_size = sizeof(char), REMOTE_FUNCTIONS};
    static const Fmi second = {.boolean_size = sizeof(int), REMOTE_FUNCTIONS, REMOTE_STATES};
    static const Fmi third = {.boolean_size = sizeof(bool), REMOTE_FUNCTIONS, REMOTE_STATES};
    static const Fmi *const tables[] = {&first, &second, &third};

    return version >= 1 && version <= 3 ? tables[version - 1] : NULL;
}

#endif
