#include "served.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if !defined _WIN32
#include <fcntl.h>
#include <signal.h>
#include <unistd.h>
#endif

#include "log.h"
#include "serving.h"

static const uint64_t FOR_EVER = UINT64_MAX;

static void *scratch_of(size_t size) {
    if (size > served.room) {
        served.scratch = serving_memory(served.scratch, size);
        served.room = size;
    }
    return served.scratch == NULL ? (served.scratch = serving_memory(NULL, 0)) : served.scratch;
}

static void send(char code, Packet *packet) {
    mutex_lock(&served.sending);
    const Arrival arrival = channel_send(served.channel, code, packet, FOR_EVER);
    mutex_unlock(&served.sending);
    if (arrival != CAME) {
        serving_end(0);
    }
}

/* Sends a message of the FMU at once, since the next call may be the last. */
static void pass_on(uint64_t environment, int status, const char *category, const char *text) {
    Packet *packet = &served.message;

    packet_clear(packet);
    PUT(packet, environment);
    PUT(packet, status);
    packet_put_text(packet, category);
    packet_put_text(packet, text);
    send(MESSAGE, packet);
}

/* Instances */

static size_t free_place(void) {
    for (size_t i = 0; i < served.number_of_instances; i++) {
        if (served.instances[i].component == NULL) {
            return i;
        }
    }
    const size_t count = served.number_of_instances + 1;
    served.instances = serving_memory(served.instances, count * sizeof *served.instances);
    served.instances[count - 1] = (Instance){.component = NULL};
    served.number_of_instances = count;
    return count - 1;
}

static void answer_instantiate(void) {
    Identity identity = {.token = served.token,
                         .resources = served.resources,
                         .solving = &served.solving,
                         .floats = &served.floats};

    const uint32_t place = (uint32_t)free_place();
    Instance *me = &served.instances[place];
    me->name = serving_copy(packet_take_text(&served.in));
    identity.name = me->name;
    TAKE(&served.in, identity.environment);
    TAKE(&served.in, identity.logging);
    me->component = served.fmi->instantiate(&served.library, &identity);
    const bool made = me->component != NULL;
    if (!made) {
        free(me->name);
    }
    floats_restore_if_seen(&served.floats);
    packet_clear(&served.out);
    PUT(&served.out, made);
    PUT(&served.out, place);
}

static void answer_free(Instance *me) {
    served.fmi->free_instance(&served.library, me->component);
    me->component = NULL;
    free(me->name);
    serving_answer(STATUS_OK);
}

static void answer_choose_messages(Instance *me) {
    const size_t count = serving_take_size();
    serving_answer(served.fmi->choose_messages == NULL
                      ? STATUS_OK
                      : served.fmi->choose_messages(&served.library, me->component,
                                                    served.categories,
                                                    count > 0 ? served.number_of_categories : 0));
}

/* Initialization */

static bool serve_next(Status *status);

/* Lets the other side do its part, and answers the requests that this takes. */
static Status call_back(uint8_t what) {
    Status status = STATUS_ERROR;

    floats_restore_if_seen(&served.floats);
    packet_clear(&served.out);
    PUT(&served.out, what);
    send(CALL_BACK, &served.out);
    while (serve_next(&status)) {
    }
    return status;
}

static Status set_starts(void *unused) {
    (void)unused;
    return call_back(CALLED_FOR_STARTS);
}

static Status exchange_values(void *unused) {
    (void)unused;
    return call_back(CALLED_FOR_EXCHANGE);
}

static void answer_initialize(size_t number) {
    Experiment experiment = {.number_of_structural = served.number_of_structural,
                             .structural_references = served.structural_references,
                             .structural_values = served.structural_values};
    bool exchanges;
    const char *doing = "initialization";

    TAKE(&served.in, experiment.start_time);
    TAKE(&served.in, experiment.stop_time);
    TAKE(&served.in, experiment.tolerance);
    TAKE(&served.in, experiment.has_stop_time);
    TAKE(&served.in, experiment.has_tolerance);
    TAKE(&served.in, exchanges);
    const StartValues values = {.set = set_starts, .exchange = exchanges ? exchange_values : NULL};
    serving_answer(served.fmi->initialize(&served.library, served.instances[number].component,
                                         &experiment, values, &doing));
    packet_put_text(&served.out, doing);
}

/* Values */

static const uint32_t *listed(size_t count) {
    const size_t size = count * sizeof(uint32_t);
    const char *bytes = packet_see(&served.in, size);

    for (List *list = served.lists; list != NULL && bytes != NULL; list = list->next) {
        if (list->count == count && memcmp(list->references, bytes, size) == 0) {
            return list->references;
        }
    }
    if (bytes == NULL) {
        return NULL;
    }
    List *list = serving_memory(NULL, sizeof *list + size);
    memcpy(list->references, bytes, size);
    list->count = count;
    list->next = served.lists;
    served.lists = list;
    return list->references;
}

typedef struct {
    Type type;
    size_t count, size; /* of references and values */
    const uint32_t *references;
} Asked;

static bool take_asked(Asked *asked) {
    const size_t type = serving_take_size();

    asked->type = (Type)(type < NUMBER_OF_TYPES ? type : 0);
    asked->count = serving_take_size();
    asked->size = serving_take_size();
    asked->references = listed(asked->count);
    return served.in.sound && type < NUMBER_OF_TYPES;
}

static void answer_get(Instance *me) {
    Asked asked;
    Status status = STATUS_ERROR;
    size_t size = 0;

    if (take_asked(&asked)) {
        size = asked.size * value_size(served.fmi, asked.type);
        status = served.fmi->get(&served.library, me->component, asked.type, asked.references,
                                 asked.count, scratch_of(size), asked.size);
    }
    serving_answer(status);
    packet_put(&served.out, scratch_of(size), size);
}

static void answer_set(Instance *me) {
    Asked asked;
    Status status = STATUS_ERROR;

    if (take_asked(&asked)) {
        const size_t size = asked.size * value_size(served.fmi, asked.type);
        void *values = scratch_of(size);
        packet_take(&served.in, values, size);
        status = served.fmi->set(&served.library, me->component, asked.type, asked.references,
                                 asked.count, values, asked.size);
    }
    serving_answer(status);
}

static void answer_get_string(Instance *me) {
    const uint32_t reference = (uint32_t)serving_take_size();
    const char *text = NULL;

    serving_answer(served.fmi->get_string(&served.library, me->component, reference, &text));
    packet_put_text(&served.out, text);
}

static void answer_set_string(Instance *me) {
    const uint32_t reference = (uint32_t)serving_take_size();
    char *text = serving_copy(packet_take_text(&served.in));

    serving_answer(served.fmi->set_string(&served.library, me->component, reference, text));
    free(text);
}

/* Steps */

static Status set_waiting(Instance *me, uint32_t waiting) {
    Status status = STATUS_OK;

    for (size_t i = 0; i < served.inputs.count && status <= STATUS_WARNING; i++) {
        const Batch *batch = &served.inputs.batches[i];
        if ((waiting >> i & 1) != 0) {
            void *values = scratch_of(batch->size);
            packet_take(&served.in, values, batch->size);
            status = served.fmi->set(&served.library, me->component, batch->type,
                                     batch->references, batch->count, values,
                                     batch->size / value_size(served.fmi, batch->type));
            floats_restore_if_seen(&served.floats);
        }
    }
    return status;
}

/* Adds the outputs to the answer: a status for each batch, and the values if it is good. */
static void put_outputs(Instance *me) {
    for (size_t i = 0; i < served.outputs.count; i++) {
        const Batch *batch = &served.outputs.batches[i];
        void *values = scratch_of(batch->size);
        const Status got = served.fmi->get(&served.library, me->component, batch->type,
                                           batch->references, batch->count, values,
                                           batch->size / value_size(served.fmi, batch->type));
        const uint8_t status = (uint8_t)got;
        floats_restore_if_seen(&served.floats);
        PUT(&served.out, status);
        if (got > STATUS_WARNING) {
            return; /* who asks for the rest gets the status once more */
        }
        packet_put(&served.out, values, batch->size);
    }
}

static void answer_step(Instance *me) {
    double time, step;
    bool no_return;
    uint32_t waiting;

    TAKE(&served.in, time);
    TAKE(&served.in, step);
    TAKE(&served.in, no_return);
    TAKE(&served.in, waiting);
    Status status = set_waiting(me, waiting);
    if (status <= STATUS_WARNING) {
        status =
            served.fmi->do_step(&served.library, me->component, time, step, no_return);
    }
    serving_answer(status);
    if (status <= STATUS_WARNING || status == STATUS_TERMINATED) {
        put_outputs(me);
    }
}

/* Requests */

/* Answers a request for an instance. Returns whether there is one with this code. */
static bool answer_one(char code, Instance *me) {
    switch (code) {
    case ASK_CHOOSE_MESSAGES: answer_choose_messages(me); return true;
    case ASK_STEP: answer_step(me); return true;
    case ASK_GET: answer_get(me); return true;
    case ASK_SET: answer_set(me); return true;
    case ASK_SET_STRING: answer_set_string(me); return true;
    case ASK_GET_STRING: answer_get_string(me); return true;
    case ASK_RESET: serving_answer(served.fmi->reset(&served.library, me->component)); return true;
    case ASK_TERMINATE:
        serving_answer(served.fmi->terminate(&served.library, me->component));
        return true;
    case ASK_FREE: answer_free(me); return true;
    case ASK_GET_STATE: serving_get_state(me); return true;
    case ASK_SET_STATE: serving_set_state(me); return true;
    case ASK_FREE_STATE: serving_free_state(me); return true;
    case ASK_STATE_SIZE: serving_state_size(me); return true;
    case ASK_SERIALIZE: serving_serialize(me); return true;
    case ASK_DESERIALIZE: serving_deserialize(me); return true;
    default: return false;
    }
}

static void answer(char code) {
    if (code == ASK_OPEN) {
        serving_open();
    } else if (code == ASK_INSTANTIATE) {
        answer_instantiate();
    } else {
        const size_t number = serving_take_size();
        const bool known = number < served.number_of_instances &&
                           served.instances[number].component != NULL;
        if (known && code == ASK_INITIALIZE) {
            answer_initialize(number);
        } else if (!known || !answer_one(code, &served.instances[number])) {
            serving_answer(STATUS_ERROR);
        }
    }
    send(ANSWER, &served.out);
}

/* Returns false when the other side lets an initialization go on, and its status. */
static bool serve_next(Status *status) {
    char code;

    if (channel_receive(served.channel, &code, &served.in, FOR_EVER) != CAME) {
        serving_end(0); /* the other side is gone, and nobody needs what is there */
    }
    if (code == GO_ON) {
        int32_t number;
        TAKE(&served.in, number);
        *status = (Status)number;
        return false;
    }
    answer(code);
    return true;
}

void serve_component(Channel *channel) {
    Status unused;

    served.channel = channel;
    served.floats = floats_now();
    mutex_reset(&served.sending);
    log_pass_to(pass_on);
    for (;;) {
        serve_next(&unused);
    }
}

#if !defined _WIN32

/* The first are meant for the other side, and often sent to all of its processes. The others would stop
 * a process in the background that uses the terminal. */
static void ignore_signals(void) {
    static const int ignored[] = {SIGINT, SIGTERM, SIGHUP, SIGTTIN, SIGTTOU};

    for (size_t i = 0; i < sizeof ignored / sizeof *ignored; i++) {
        signal(ignored[i], SIG_IGN);
    }
}

/* An FMU that hangs must not outlive the other side. */
static void *end_with_parent(void *unused) {
    const pid_t parent = getppid();

    (void)unused;
    while (getppid() == parent) {
        sleep(1);
    }
    serving_end(1);
    return NULL;
}

void serve_standard_streams(void) {
    static Channel channel;
    pthread_t watch;
    const int connection = fcntl(0, F_DUPFD_CLOEXEC, 3), nothing = open("/dev/null", O_RDONLY);

    if (connection >= 0 && nothing >= 0 && channel_open(&channel, connection)) {
        dup2(nothing, 0);
        dup2(2, 1);
        close(nothing);
        ignore_signals();
        pthread_create(&watch, NULL, end_with_parent, NULL);
        serve_component(&channel);
    }
}

#endif
