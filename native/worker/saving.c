/* Requests for snapshots. */

#include "worker.h"

Answer answer_save(Worker *w, Reader *reader, Writer *writer) {
    const bool able = w->opening.settings.can_save;
    Snapshot *snapshot = able ? snapshot_new(w->opening.settings.count) : NULL;

    if (snapshot == NULL) {
        return answer_refusal(writer,
                              able ? "out of memory" : "the FMU cannot get and set its state");
    }
    const ptrdiff_t failed = pool_save(&w->pool, snapshot);
    if (failed < 0) {
        write_integer(writer, (int64_t)w->number_of_snapshots);
        w->snapshots =
            memory_for(w->snapshots, (w->number_of_snapshots + 1) * sizeof *w->snapshots);
        w->snapshots[w->number_of_snapshots++] = snapshot;
    }
    return answer_after(&w->pool, reader, writer, failed);
}

static Snapshot **snapshot_of(Worker *w, int64_t number) {
    const bool known = number >= 0 && (size_t)number < w->number_of_snapshots;
    return known && w->snapshots[number] != NULL ? &w->snapshots[number] : NULL;
}

Answer answer_restore(Worker *w, Reader *reader, Writer *writer) {
    Snapshot **snapshot = snapshot_of(w, read_integer(reader));
    const Block mask = read_block(reader);
    size_t troubled;

    if (snapshot == NULL || mask.size != w->opening.settings.count) {
        return answer_refusal(writer, "there is no such snapshot");
    }
    return pool_restore(&w->pool, *snapshot, (Mask){mask.bytes, 1}, &troubled)
               ? ANSWER_RESULT
               : answer_refusal(writer, "the snapshot is of another instance than this one");
}

Answer answer_release(Worker *w, Reader *reader) {
    size_t count;
    const int64_t *numbers = read_array(reader, sizeof *numbers, &count);

    for (size_t i = 0; i < count; i++) {
        Snapshot **snapshot = snapshot_of(w, numbers[i]);
        if (snapshot != NULL) {
            pool_abandon(&w->pool, *snapshot);
            *snapshot = NULL;
        }
    }
    return ANSWER_RESULT;
}
