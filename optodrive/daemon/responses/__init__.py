"""Every JSON body that the daemon sends, stated once as Pydantic models.

Routes declare them, the engine builds them, the client parses them, and tests compare the page's field names with
them. The package imports neither FastAPI nor numba, so that the client can import it.
"""
