#include "far.h"
#include "remote.h"

#if defined _WIN32

#include <stdio.h>

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

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "log.h"
#include "served.h"

/* Workers */

static void put_texts(Packet *packet, const char *const *texts, size_t count) {
    packet_put_size(packet, count);
    for (size_t i = 0; i < count; i++) {
        packet_put_text(packet, texts[i]);
    }
}

static void put_solving(Packet *packet, const Solving *s) {
    packet_put_text(packet, s->method == NULL ? "" : s->method->name);
    PUT(packet, s->tolerance);
    PUT(packet, s->max_step);
    packet_put_size(packet, s->states);
    packet_put_size(packet, s->indicators);
    PUT(packet, s->completes);
    packet_put_block(packet, s->state_references, s->states * sizeof(uint32_t));
    packet_put_block(packet, s->rate_references, s->states * sizeof(uint32_t));
    packet_put_block(packet, s->clocks, s->number_of_clocks * sizeof(Clock));
    packet_put_block(packet, s->clocked, s->number_of_clocked * sizeof(Clocked));
}

static void put_groups(Packet *packet, const Access *access) {
    packet_put_size(packet, access->number_of_groups);
    for (size_t i = 0; i < access->number_of_groups; i++) {
        const Group *group = &access->groups[i];
        packet_put_size(packet, group->type);
        packet_put_size(packet, group->size);
        packet_put_block(packet, group->references, group->count * sizeof(uint32_t));
    }
}

/* In the order in which served.c takes it. */
static void put_opening(Packet *packet, const Component *part) {
    packet_clear(packet);
    PUT(packet, part->version);
    PUT(packet, part->manner);
    packet_put_text(packet, part->model);
    packet_put_text(packet, part->token);
    packet_put_text(packet, part->resources);
    packet_put_text(packet, part->remote->path);
    put_texts(packet, part->categories, part->number_of_categories);
    put_solving(packet, &part->solving);
    packet_put_block(packet, part->structural_references,
                     part->number_of_structural * sizeof(uint32_t));
    packet_put_block(packet, part->structural_values,
                     part->number_of_structural * sizeof(uint64_t));
    put_groups(packet, &part->inputs);
    put_groups(packet, &part->outputs);
    put_texts(packet, part->remote->preload, part->remote->number_of_preloads);
}

static bool start(Host *host, const Component *part, char *error, size_t size) {
    const Remote *remote = part->remote;
    return host_start(host, remote->command, remote->environment, error, size);
}

/* Lets a new worker load the library. */
static bool load(Host *host, const Component *part, char *error, size_t size) {
    bool opened;
    char answer;

    put_opening(&host->out, part);
    if (!host_ask(host, ASK_OPEN, PATIENT, &answer)) {
        snprintf(error, size, "%s", host->fate == NULL ? "out of memory" : host->fate);
        return false;
    }
    TAKE(&host->in, opened);
    if (!opened) {
        snprintf(error, size, "%s", packet_take_text(&host->in));
        host_end(host);
    }
    return opened;
}

bool remote_open(Library *library, const Component *part, size_t parts, char *error, size_t size) {
    const size_t count = part->remote->workers;
    Hosts *all = calloc(1, sizeof *all + count * sizeof(Host));
    bool good = all != NULL;

    library->functions = all;
    if (!good) {
        snprintf(error, size, "out of memory");
        return false;
    }
    *all = (Hosts){.part = part, .parts = parts, .count = count};
    for (size_t i = 0; i < count; i++) {
        host_open(&all->hosts[i], part->label, part->remote->call_timeout);
    }
    for (size_t i = 0; i < count && good; i++) {
        good = start(&all->hosts[i], part, error, size);
    }
    for (size_t i = 0; i < count && good; i++) {
        good = load(&all->hosts[i], part, error, size);
    }
    return good;
}

void remote_close(Library *library) {
    Hosts *all = hosts_of(library);

    for (size_t i = 0; all != NULL && i < all->count; i++) {
        host_begin_closing(&all->hosts[i]);
    }
    for (size_t i = 0; all != NULL && i < all->count; i++) {
        host_close(&all->hosts[i]);
    }
    free(all);
    library->functions = NULL;
}

/* Requests of an instance */

bool far_is_alive(const Far *me) {
    return me->host->process != 0 && me->generation == me->host->generation;
}

void far_begin(Far *me) {
    if (!me->holds) {
        mutex_lock(&me->host->lock);
    }
    packet_clear(&me->host->out);
    PUT(&me->host->out, me->number);
}

void far_end(Far *me) {
    if (!me->holds) {
        mutex_unlock(&me->host->lock);
    }
}

bool far_send(Far *me, char code, int patience, char *answer) {
    const bool sent = far_is_alive(me) && host_ask(me->host, code, patience, answer);

    if (!sent) {
        me->fate = me->host->fate;
    }
    return sent;
}

Status far_take_status(Far *me) {
    int32_t status;

    TAKE(&me->host->in, status);
    return me->host->in.sound ? (Status)status : STATUS_FATAL;
}

Status far_ask(Far *me, char code) {
    char answer;
    return far_send(me, code, 1, &answer) ? far_take_status(me) : STATUS_FATAL;
}

Status far_ask_simply(Far *me, char code) {
    far_begin(me);
    const Status status = far_ask(me, code);
    far_end(me);
    return status;
}

/* Instances */

size_t far_size_of_group(const Access *access, size_t index) {
    const Group *group = &access->groups[index];
    return group->size * value_size(access->fmi, group->type);
}

static size_t far_size_before(const Access *access, size_t index) {
    size_t size = 0;
    for (size_t i = 0; i < index; i++) {
        size += far_size_of_group(access, i);
    }
    return size;
}

char *far_input_values(Far *me, size_t index) {
    return me->values + far_size_before(&me->part->inputs, index);
}

char *far_output_values(Far *me, size_t index) {
    const Access *inputs = &me->part->inputs;
    return me->values + far_size_before(inputs, inputs->number_of_groups) +
           far_size_before(&me->part->outputs, index);
}

/* Neighbours share a worker, as they share a thread. */
static Host *host_for(Hosts *all, uint64_t environment) {
    const size_t instance = (size_t)(environment & UINT32_MAX) / all->parts;
    const size_t host = instance * all->count / all->part->remote->instances;
    return &all->hosts[host < all->count ? host : all->count - 1];
}

static bool make(Far *me) {
    const Identity *identity = &me->identity;
    Packet *out = &me->host->out;
    bool made;
    char answer, error[1024];

    const bool is_new = me->host->process == 0;
    if (!start(me->host, me->part, error, sizeof error) ||
        (is_new && !load(me->host, me->part, error, sizeof error))) {
        log_deliver(identity->environment, STATUS_ERROR, "fmugym", error);
        return false;
    }
    me->generation = me->host->generation;
    me->fate = NULL;
    packet_clear(out);
    packet_put_text(out, identity->name);
    PUT(out, identity->environment);
    PUT(out, identity->logging);
    if (!far_send(me, ASK_INSTANTIATE, PATIENT, &answer)) {
        snprintf(error, sizeof error, "%s", me->fate == NULL ? "" : me->fate);
        log_deliver(identity->environment, STATUS_FATAL, "fmugym", error);
        return false;
    }
    uint32_t number;
    TAKE(&me->host->in, made);
    TAKE(&me->host->in, number);
    me->number = number;
    return made;
}

void *far_instantiate(const Library *library, const Identity *identity) {
    Hosts *all = hosts_of(library);
    const Access *inputs = &all->part->inputs, *outputs = &all->part->outputs;
    const size_t size = far_size_before(inputs, inputs->number_of_groups) +
                        far_size_before(outputs, outputs->number_of_groups);
    Far *me = calloc(1, sizeof *me + size);

    if (me == NULL) {
        return NULL;
    }
    me->part = all->part;
    me->host = host_for(all, identity->environment);
    me->identity = *identity;
    mutex_lock(&me->host->lock);
    const bool made = make(me);
    mutex_unlock(&me->host->lock);
    if (!made) {
        free(me);
    }
    return made ? me : NULL;
}

void far_drop(const Library *library, void *component) {
    (void)library;
    free(component);
}

void far_free(const Library *library, void *component) {
    far_ask_simply(component, ASK_FREE);
    far_drop(library, component);
}

const char *far_blamed(const void *component) {
    const Far *me = component;
    return me->fate;
}

void far_forget_values(Far *me) {
    me->waiting = me->fresh = 0;
}

Status far_choose_messages(const Library *library, void *component,
                              const char *const *categories, size_t count) {
    Far *me = component;

    (void)library;
    (void)categories; /* the worker knows them */
    me->categories = count;
    far_begin(me);
    packet_put_size(&me->host->out, count);
    const Status status = far_ask(me, ASK_CHOOSE_MESSAGES);
    far_end(me);
    return status;
}

bool far_made_anew(Far *me) {
    mutex_lock(&me->host->lock);
    const bool made = !far_is_alive(me) && make(me);
    mutex_unlock(&me->host->lock);
    if (made && me->categories > 0) {
        far_choose_messages(NULL, me, NULL, me->categories);
    }
    return made;
}

#endif
