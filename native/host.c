#include "host.h"

#if !defined _WIN32

#include <fcntl.h>
#include <math.h>
#include <signal.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include "log.h"
#include "served.h"
#include "texts.h"

enum {
    MOST_DEATHS = 5,       /* in a row, after which no process is started any more */
    FIRST_PAUSE = 50,      /* milliseconds before the third start; doubled for each more */
    LAST_MOMENT = 50,      /* milliseconds that one without a connection may take to end */
    CLOSING_TIME = 5000,   /* milliseconds that one may take to end */
    LONGEST_KILL = 2000,   /* a system call may hold it */
    SLICE = 1000           /* milliseconds between looks at the process itself */
};

static const uint64_t MILLISECOND = 1000000;

static Mutex list_lock = MUTEX_INITIALIZER;
static Host *hosts;

/* Forks. The processes stay with the one that started them. */

static void forget(Host *host) {
    channel_close(&host->channel);
    host->process = 0;
    host->generation++;
}

static void set_fate(Host *host, const char *how) {
    char text[512];

    snprintf(text, sizeof text, "%s, whose worker process %s", host->label, how);
    host->fate = text_with(text_number(text));
}

static void before_fork(void) {
    mutex_lock(&list_lock);
}

static void after_fork_in_parent(void) {
    mutex_unlock(&list_lock);
}

static void after_fork_in_child(void) {
    mutex_reset(&list_lock);
    for (Host *host = hosts; host != NULL; host = host->next) {
        mutex_reset(&host->lock);
        if (host->process != 0) {
            forget(host);
            set_fate(host, "stayed with the process that this one was forked from");
        }
    }
}

static void prepare_for_forks(void) {
    pthread_atfork(before_fork, after_fork_in_parent, after_fork_in_child);
}

void host_open(Host *host, const char *label, double call_timeout) {
    static pthread_once_t once = PTHREAD_ONCE_INIT;

    pthread_once(&once, prepare_for_forks);
    *host = (Host){.label = label, .call_timeout = call_timeout, .fault = -1};
    mutex_reset(&host->lock);
    mutex_lock(&list_lock);
    host->next = hosts;
    hosts = host;
    mutex_unlock(&list_lock);
}

/* The end of a process */

/* Waits for the end. Returns whether it has come; the status is -1 if somebody else was told. */
static bool has_ended(pid_t process, int milliseconds, int *status) {
    const uint64_t end = clock_now() + (uint64_t)milliseconds * MILLISECOND;

    for (;;) {
        const pid_t found = waitpid(process, status, WNOHANG);
        if (found < 0) {
            *status = -1;
        }
        if (found != 0 || clock_now() >= end) {
            return found != 0;
        }
        clock_sleep_until(clock_now() + MILLISECOND / 2);
    }
}

static const char *name_of_signal(int number) {
    static const struct {
        int number;
        const char *name;
    } names[] = {{SIGSEGV, "SIGSEGV"}, {SIGABRT, "SIGABRT"}, {SIGBUS, "SIGBUS"},
                 {SIGFPE, "SIGFPE"},   {SIGILL, "SIGILL"},   {SIGKILL, "SIGKILL"},
                 {SIGTERM, "SIGTERM"}};

    for (size_t i = 0; i < sizeof names / sizeof *names; i++) {
        if (names[i].number == number) {
            return names[i].name;
        }
    }
    return NULL;
}

static void describe_end(const Host *host, int status, char *text, size_t size) {
    if (host->fault >= 0) {
        snprintf(text, size, "ended with Windows error 0x%llx", (unsigned long long)host->fault);
    } else if (status != -1 && WIFEXITED(status)) {
        snprintf(text, size, "ended with exit status %d", WEXITSTATUS(status));
    } else if (status != -1 && WIFSIGNALED(status) && name_of_signal(WTERMSIG(status)) != NULL) {
        snprintf(text, size, "ended with signal %s", name_of_signal(WTERMSIG(status)));
    } else if (status != -1 && WIFSIGNALED(status)) {
        snprintf(text, size, "ended with signal %d", WTERMSIG(status));
    } else {
        snprintf(text, size, "closed its connection");
    }
}

static void end_by_force(pid_t process) {
    int status;

    kill(process, SIGKILL);
    has_ended(process, LONGEST_KILL, &status);
}

static void lose(Host *host, Arrival arrival, int patience) {
    char how[128];
    int status = -1;

    if (arrival == LATE) {
        end_by_force(host->process);
        snprintf(how, sizeof how, "took longer than %scall_timeout (%g s) and was ended",
                 patience > 1 ? "ten times " : "", host->call_timeout);
    } else {
        if (!has_ended(host->process, LAST_MOMENT, &status)) {
            end_by_force(host->process);
            status = -1;
        }
        describe_end(host, status, how, sizeof how);
    }
    forget(host);
    host->deaths++;
    set_fate(host, how);
}

/* The beginning */

/* Both ends stay out of other programs that this process starts. */
static bool connect_ends(int ends[2]) {
#if defined SOCK_CLOEXEC /* other threads start programs meanwhile */
    return socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends) == 0;
#else
    if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends) != 0) {
        return false;
    }
    for (int i = 0; i < 2; i++) {
        fcntl(ends[i], F_SETFD, FD_CLOEXEC);
    }
    return true;
#endif
}

/* In a process group of its own, so that Ctrl-C is for this process alone. */
static int spawn(pid_t *process, int end, const char *const *command,
                 const char *const *environment) {
    posix_spawn_file_actions_t actions;
    posix_spawnattr_t attributes;
    sigset_t none;

    sigemptyset(&none);
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, end, 0);
    posix_spawn_file_actions_adddup2(&actions, end, 1);
    posix_spawnattr_init(&attributes);
    posix_spawnattr_setsigmask(&attributes, &none);
    posix_spawnattr_setpgroup(&attributes, 0);
    posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK | POSIX_SPAWN_SETPGROUP);
    const int fault = posix_spawn(process, command[0], &actions, &attributes,
                                  (char *const *)command, (char *const *)environment);
    posix_spawnattr_destroy(&attributes);
    posix_spawn_file_actions_destroy(&actions);
    return fault;
}

static bool start(Host *host, const char *const *command, const char *const *environment,
                  char *error, size_t size) {
    int ends[2];

    if (!connect_ends(ends)) {
        snprintf(error, size, "there are no connections left");
        return false;
    }
    const int fault = spawn(&host->process, ends[1], command, environment);
    close(ends[1]);
    if (fault != 0) {
        snprintf(error, size, "%.400s cannot be started: %s", command[0], strerror(fault));
        host->process = 0;
        close(ends[0]);
        return false;
    }
    host->fault = -1;
    if (!channel_open(&host->channel, ends[0])) {
        end_by_force(host->process);
        forget(host);
        snprintf(error, size, "out of memory");
        return false;
    }
    return true;
}

bool host_start(Host *host, const char *const *command, const char *const *environment,
                char *error, size_t size) {
    if (host->process != 0) {
        return true;
    }
    if (host->deaths >= MOST_DEATHS) {
        snprintf(error, size, "given up after %d deaths in a row: %s", host->deaths,
                 host->fate == NULL ? "" : host->fate);
        return false;
    }
    if (host->deaths > 1) {
        clock_sleep_until(clock_now() + (FIRST_PAUSE * MILLISECOND << (host->deaths - 2)));
    }
    return start(host, command, environment, error, size);
}

void host_end(Host *host) {
    end_by_force(host->process);
    forget(host);
    host->deaths++;
}

void host_praise(Host *host) {
    host->deaths = 0;
}

void host_begin_closing(Host *host) {
    mutex_lock(&host->lock);
    if (host->process != 0) {
        shutdown(host->channel.socket, SHUT_RDWR);
    }
    mutex_unlock(&host->lock);
}

void host_close(Host *host) {
    int status;

    if (host->process != 0) {
        if (!has_ended(host->process, CLOSING_TIME, &status)) {
            end_by_force(host->process);
        }
        forget(host);
    }
    mutex_lock(&list_lock);
    for (Host **link = &hosts; *link != NULL; link = &(*link)->next) {
        if (*link == host) {
            *link = host->next;
            break;
        }
    }
    mutex_unlock(&list_lock);
    mutex_destroy(&host->lock);
    packet_free(&host->out);
    packet_free(&host->in);
}

/* Requests */

static void take_message(Packet *packet) {
    uint64_t environment;
    int status;
    char copy[4096];

    TAKE(packet, environment);
    TAKE(packet, status);
    const char *category = packet_take_text(packet);
    snprintf(copy, sizeof copy, "%s", packet_take_text(packet));
    log_deliver(environment, status, category, copy);
}

static uint64_t deadline_of(const Host *host, int patience) {
    const double seconds = host->call_timeout * patience;
    return seconds < 1e9 ? clock_now() + (uint64_t)(seconds * 1e9) : UINT64_MAX;
}

/* A process that the worker has started may hold the connection, so now and then this looks whether
 * the worker itself is there. */
static bool is_there(const Host *host) {
    siginfo_t found = {.si_pid = 0};
    return waitid(P_PID, (id_t)host->process, &found, WEXITED | WNOHANG | WNOWAIT) == 0 &&
           found.si_pid == 0;
}

static Arrival receive(Host *host, char *code, uint64_t deadline) {
    for (;;) {
        const uint64_t slice = clock_now() + SLICE * MILLISECOND;
        const Arrival arrival =
            channel_receive(&host->channel, code, &host->in, slice < deadline ? slice : deadline);
        if (arrival != LATE || clock_now() >= deadline) {
            return arrival;
        }
        if (!is_there(host)) {
            return GONE;
        }
    }
}

bool host_ask(Host *host, char code, int patience, char *answer) {
    const uint64_t deadline = deadline_of(host, patience);
    Arrival arrival = channel_send(&host->channel, code, &host->out, deadline);

    while (arrival == CAME) {
        arrival = receive(host, answer, deadline);
        if (arrival == CAME && *answer == MESSAGE) {
            take_message(&host->in);
        } else if (arrival == CAME && *answer == FAULT) {
            uint32_t fault;
            TAKE(&host->in, fault);
            host->fault = fault;
        } else if (arrival == CAME) {
            return true;
        }
    }
    lose(host, arrival, patience);
    return false;
}

#endif
