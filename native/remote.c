#include "remote.h"

#include <string.h>

#include "far.h"
#include "served.h"
#include "texts.h"

#if defined _WIN32

const Fmi *remote_table(int64_t version) {
    (void)version;
    return NULL;
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
    .exchange = exchange_one_by_one, .get = far_get, .set = far_set, .set_string = far_set_string,             \
    .get_string = far_get_string, .reset = reset, .terminate = terminate, .free_instance = far_free,   \
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
