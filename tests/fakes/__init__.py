"""Fakes: replacements for slow or external parts of the program, and small models with known answers.

| module | content | used by tests of |
|---|---|---|
| `composites` | replacements for the composite models of MJX that MuJoCo 4 no longer compiles | physics, step |
| `experiment_fake` | a published experiment that simulates nothing | experiments, cli, runs |
| `explore_data` | directories and recordings for the pages of `view` | view, learn |
| `learn_toy` | an environment of `learn` in closed form: a point mass | learn |
| `measured` | a log of a robot that plain MuJoCo simulates | hardware, cli |
| `published_maze` | the table of the published maze, and the distance to its boxes | robot, control |
| `ray_disturbed` | a program: a sweep on a Ray cluster whose nodes are killed | runs |
| `ray_fake` | a program: small jobs on Ray clusters of this machine | runs |
| `search_fake` | a simulator in closed form for searches; also a program to be killed | optimize, runs |
| `special_states` | small models at rest, at limits, aligned or coincident; also a program | dynamics |
| `strangers` | code that leaves a trace if it runs, special files, and limits of time and memory | files, trust |
| `sweep_fake` | a simulator in closed form for sweeps; also a program to be killed | sweep, plotting, runs, view |
| `swinging` | a driven pendulum that touches the ground, as robot and loop of an engine | physics |
| `tune_fake` | a tuning problem in closed form; also a program to be killed | optimize, plotting, runs |
| `wires` | an artificial clock, a simulated robot that exchanges messages, a broker, a bridge | live, hardware |
"""
