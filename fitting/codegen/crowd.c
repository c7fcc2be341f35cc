/* Clips of many characters, in blocks of as many as a vector has lanes. */

#define LANES @LANES
@VECTORS
typedef struct memory {
@WORK
} memory;

@FUNCTIONS

typedef struct block {
    vf input[@INPUTS + 1], state[@STATES + 1], after[@STATES + 1], result[@RESULTS + 1];
    memory work;
    char *from[@INPUTS + 1], *to[@RESULTS + 1];
    layout source[@INPUTS + 1], target[@RESULTS + 1];
    vi lane, start;
    ptrdiff_t count;
} block;

INLINE void open_block(
    block *block, const place *inputs, const place *outputs, const int *starts,
    ptrdiff_t first, ptrdiff_t count
) {
    block->count = count;
    EACH block->lane[i] = i < count ? i : (int)count - 1;
    EACH block->start[i] = starts ? starts[first + block->lane[i]] : 0;
    for (int i = 0; i < @INPUTS; i++) {
        block->from[i] = inputs[i].at + first * inputs[i].member;
        block->source[i] = layout_of(inputs + i, count == LANES, starts != NULL);
    }
    for (int i = 0; i < @RESULTS; i++) {
        block->to[i] = outputs[i].at + first * outputs[i].member;
        block->target[i] = layout_of(outputs + i, count == LANES, 0);
    }
    for (int i = 0; i < @SETUP; i++)
        block->input[i] = load(block->from[i], block->source[i], inputs + i, block->lane, block->start);
}

INLINE void read_frame(block *block, const place *inputs) {
    memcpy(block->state, block->after, sizeof block->state);
    for (int i = @SETUP; i < @INPUTS; i++) {
        block->input[i] = load(block->from[i], block->source[i], inputs + i, block->lane, block->start);
        block->from[i] += inputs[i].frame;
    }
}

INLINE void write_frame(block *block, const place *outputs) {
    for (int i = 0; i < @RESULTS; i++) {
        store(block->to[i], block->target[i], outputs[i].member, block->count, block->result[i]);
        block->to[i] += outputs[i].frame;
    }
}

void run(
    const place *inputs, const place *outputs, const void *const *tables, const int *starts,
    ptrdiff_t first, ptrdiff_t members, ptrdiff_t frames
) {
    const ptrdiff_t end = first + members;
    const unsigned mode = flush_denormals();
    block own, *block = &own;
    for (; first < end; first += LANES) {
        const ptrdiff_t count = end - first < LANES ? end - first : LANES;
        open_block(block, inputs, outputs, starts, first, count);
@INIT
        for (ptrdiff_t frame = 0; frame < frames; frame++) {
            read_frame(block, inputs);
@STEP
            write_frame(block, outputs);
        }
    }
    restore_denormals(mode);
}
