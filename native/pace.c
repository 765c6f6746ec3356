#include "pace.h"

static uint64_t claim(Pace *pace) {
    uint64_t next = atomic_get(&pace->next), slot;

    do {
        const uint64_t now = clock_now() / pace->interval + 1;
        slot = next > now ? next : now;
        slot += (pace->turn + pace->turns - slot % pace->turns) % pace->turns;
    } while (!atomic_replace(&pace->next, &next, slot + 1));
    return slot;
}

void pace_wait(Pace *pace) {
    if (pace->interval > 0) {
        clock_sleep_until(claim(pace) * pace->interval);
    }
}
