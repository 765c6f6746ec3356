#include "pace.h"

uint64_t pace_claim(const Pace *pace) {
    uint64_t last = atomic_get(pace->last), next;

    do {
        const uint64_t now = clock_now();
        next = last == 0 || last + pace->interval < now ? now : last + pace->interval;
    } while (!atomic_replace(pace->last, &last, next));
    return next;
}

void pace_wait(const Pace *pace) {
    if (pace->interval > 0) {
        clock_sleep_until(pace_claim(pace));
    }
}
