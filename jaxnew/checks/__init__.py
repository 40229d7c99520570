"""Whether a user's environment or policy is what the rest relies on; each mistake in one sentence.

    jaxnew.check_environment(MyEnvironment())
    jaxnew.check_method(MyMethod(jaxnew.MethodContext()))

`train` and `sweep` run them before they compile; of what an installed package brings, the forms.
"""
