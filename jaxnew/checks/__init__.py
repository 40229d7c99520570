"""Whether a user's environment or policy is what the rest relies on; each mistake in one sentence.

    jaxnew.check_environment(MyEnvironment())
    jaxnew.check_method(MyMethod(jaxnew.MethodContext()))

`train` and `sweep` run them before they compile, on the host through a small pool. Of environments
that an installed package brings, they look at the forms of those inside jit alone.
"""
